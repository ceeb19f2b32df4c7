"""Factors that the caller adds to the keyframe graph, on its variables and on variables of their own.

They cross processes and files as GTSAM's own text. What they say of keyframes that have become constant is condensed
to a quadratic on the caller's variables that are still in use, so that an update stays as cheap as it is.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, X
from numpy.typing import NDArray

from factorsfm.graph.factors import (
    HELD,
    landmark_prior,
    native_affine,
    native_affine_noise,
    pose_from_camera,
    pose_prior,
)
from factorsfm.graph.keys import keys_of, letter_of, name_of, ordering_of, part_of
from factorsfm.graph.window import Window

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_GROSS = 30.0  # standard deviations, of a factor that is grossly off
RESERVED = {
    "x": "a keyframe of the map", "l": "a landmark of the map", "a": "a keyframe with a depth map",
    "k": "a variable that takes added factors", "t": "a variable that takes added factors",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AddedFactors:
    """Factors of the caller, and the variables of their own.

    Attributes:
        numbers: of the factors in their order; a number is never used again.
        factors, own: `gtsam.NonlinearFactorGraph` and `gtsam.Values` as text, empty without any.
    """

    numbers: tuple[int, ...] = ()
    factors: str = ""
    own: str = ""

    @classmethod
    def of(cls, numbers: Iterable[int], graph: gtsam.NonlinearFactorGraph, own: gtsam.Values) -> AddedFactors:
        """From GTSAM's objects."""
        factors = graph.serialize() if graph.size() else ""
        return cls(tuple(numbers), factors, own.serialize() if own.size() else "")

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors, in the order of the numbers."""
        graph = gtsam.NonlinearFactorGraph()
        if self.factors:
            graph.deserialize(self.factors)
        return graph

    def values(self) -> gtsam.Values:
        """Of the variables of the caller's own."""
        values = gtsam.Values()
        if self.own:
            values.deserialize(self.own)
        return values

    @property
    def own_names(self) -> set[int]:
        """The variables of the caller's own."""
        return set(self.values().keys())

    @property
    def named(self) -> set[int]:
        """The graph's variables that they name."""
        return {key for key in keys_of(self.graph()) if not is_own(key)} if self.numbers else set()

    @property
    def frames(self) -> set[int]:
        """Indices of the keyframes that they name, or the affines of these."""
        return {gtsam.symbolIndex(key) for key in self.named if letter_of(key) in "xa"}

    @property
    def tracks(self) -> set[int]:
        """The landmarks that they name."""
        return {gtsam.symbolIndex(key) for key in self.named if letter_of(key) == "l"}

    @classmethod
    def joined(cls, batches: Iterable[AddedFactors]) -> AddedFactors:
        """The factors of several batches, whose numbers differ."""
        numbers, graph, values = list[int](), gtsam.NonlinearFactorGraph(), gtsam.Values()
        for batch in batches:
            numbers += batch.numbers
            graph.push_back(batch.graph())
            values.insert(batch.values())
        return cls.of(numbers, graph, values)

    def with_values(self, estimate: gtsam.Values) -> AddedFactors:
        """With the caller's variables as they are in an estimate of many."""
        values = part_of(estimate, self.values().keys())
        return replace(self, own=values.serialize() if values.size() else "")


NOTHING_ADDED = AddedFactors()


class MapValues(Protocol):
    """What a map holds, None for what it does not."""

    def pose(self, frame: int) -> tuple[Array, Array] | None: ...
    def affine(self, frame: int) -> tuple[float, float] | None: ...
    def landmark(self, track: int) -> Array | None: ...


def is_own(key: int) -> bool:
    """Whether a variable is the caller's, and not one of the graph's."""
    return letter_of(key) not in RESERVED


def present_values(keys: Iterable[int], present: MapValues) -> gtsam.Values:
    """Values of the graph's variables, of those that the map holds; affines as `native_affine`."""
    values = gtsam.Values()
    for key in keys:
        letter, number = letter_of(key), gtsam.symbolIndex(key)
        if letter == "x" and (pose := present.pose(number)) is not None:
            values.insert(key, pose_from_camera(*pose))
        elif letter == "a" and (affine := present.affine(number)) is not None:
            values.insert(key, native_affine(*affine))
        elif letter == "l" and (point := present.landmark(number)) is not None:
            values.insert(key, point)
    return values


def error_of(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> float:
    """In standard deviations, the root mean square of its rows; of what was linearised, how far it is from its minimum.

    The least cost of what was linearised is that of constants: no variable can lower it.
    """
    if isinstance(factor, gtsam.LinearContainerFactor):
        # GTSAM crashes where one that was read from text is asked for its rows.
        augmented = factor.linearize(values).augmentedInformation()
        gradient = augmented[:-1, -1]
        step = np.linalg.lstsq(augmented[:-1, :-1], gradient)[0]
        return float(np.sqrt(max(float(gradient @ step), 0.0)))
    return float(np.sqrt(2.0 * max(factor.error(values), 0.0) / max(factor.dim(), 1)))


def misfit_of(added: AddedFactors, estimate: gtsam.Values) -> str:
    """Which factor is off by most, and by how many standard deviations; empty where none is grossly off."""
    graph, worst, largest = added.graph(), "", _GROSS
    for k in range(graph.size()):
        factor, size = graph.at(k), error_of(graph.at(k), estimate)
        if not size <= largest:
            names = ", ".join(map(name_of, factor.keys()))
            worst, largest = f"{type(factor).__name__} on {names} is off by {size:.0f} sigma", size
    return worst


def on_window(added: AddedFactors, window: Window, present: MapValues) -> tuple[AddedFactors, gtsam.Values]:
    """The factors as an update of this window needs them, and the values of what they name besides it."""
    if not added.numbers:
        return added, gtsam.Values()
    free = set(window.keyframes[~window.constant].tolist())
    guided = set() if window.depths is None else free & set(window.keyframes[window.depths.image].tolist())
    variables = {*map(X, free), *map(L, window.ids.tolist()), *map(A, guided)}
    named = added.named
    known = present_values(named, present)
    added = _without_lost(added, {key for key in named if not known.exists(key)})
    constants = part_of(known, named - variables)
    added = condensed(added, variables, constants)
    return added, part_of(constants, added.named)


def _without_lost(added: AddedFactors, lost: set[int]) -> AddedFactors:
    """Without factors on what the map has lost, as a landmark that turned out to be wrong."""
    if not lost:
        return added
    graph, kept, numbers = added.graph(), gtsam.NonlinearFactorGraph(), []
    for k, number in enumerate(added.numbers):
        if lost.isdisjoint(graph.at(k).keys()):
            kept.add(graph.at(k))
            numbers.append(number)
    names = ", ".join(map(name_of, sorted(lost)))
    logger.warning("%d of the factors that were added are lost with %s", len(added.numbers) - len(numbers), names)
    return AddedFactors.of(numbers, kept, part_of(added.values(), keys_of(kept)))


def condensed(added: AddedFactors, free: Collection[int], constants: gtsam.Values) -> AddedFactors:
    """The factors that say something of free variables; the others condensed to quadratics on the caller's own ones.

    Args:
        free: the graph's variables that are solved for; constants: values of those that the factors name besides.
    """
    graph, own = added.graph(), added.values()
    names = [set(graph.at(k).keys()) for k in range(graph.size())]
    live = [bool(mine & set(free)) for mine in names]
    used = {key for mine, is_live in zip(names, live, strict=True) if is_live for key in mine if is_own(key)}
    if all(is_live or mine <= used for mine, is_live in zip(names, live, strict=True)):
        return added
    kept, settled = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for k, is_live in enumerate(live):
        (kept if is_live else settled).add(graph.at(k))
    numbers = [number for number, is_live in zip(added.numbers, live, strict=True) if is_live]
    everything = gtsam.Values(constants)
    everything.insert(own)
    for key in list(part_of(constants, keys_of(settled)).keys()):
        settled.add(held_prior(key, constants))
    gone = ordering_of(sorted(keys_of(settled) - used))
    _, left = settled.linearize(everything).eliminatePartialSequential(gone)
    following = max(added.numbers) + 1
    for k in range(left.size()):
        if len(left.at(k).keys()):
            kept.add(gtsam.LinearContainerFactor(left.at(k), part_of(everything, left.at(k).keys())))
            numbers.append(following)
            following += 1
    return AddedFactors.of(numbers, kept, part_of(own, used))


def held_prior(key: int, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """Holds a pose, a landmark or an affine where it is."""
    letter = letter_of(key)
    if letter == "x":
        return pose_prior(key, values.atPose3(key), HELD)
    if letter == "l":
        return landmark_prior(key, values.atPoint3(key), HELD)
    return gtsam.PriorFactorCal3_S2(key, values.atCal3_S2(key), native_affine_noise(HELD, HELD))
