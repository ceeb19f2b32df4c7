"""Which factors of the caller's the keyframe graph can take, and what is said of the others."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import gtsam
import numpy as np

from factorsfm.graph.added_factors import RESERVED, AddedFactors, MapValues, is_own, present_values
from factorsfm.graph.keys import keys_of, letter_of, name_of, part_of
from factorsfm.graph.linear_system import LinearSystem
from factorsfm.support.errors import InputError

_LEAST_INFORMATION = 1e-10  # smallest eigenvalue of what is determined, where every variable alone has 1


def checked_factors(
    graph: object,
    values: object,
    present: MapValues,
    earlier: Sequence[AddedFactors],
    names: Collection[int],
    first: int,
) -> AddedFactors:
    """Factors of the caller's, numbered.

    Args:
        earlier: what was added before and is still in use; names: all variables of the caller's own so far.
        first: number of the first factor.

    Raises:
        InputError: another type; a Python callback; an unknown key, or one that is taken; a value of another type than
            the factor expects; a standard deviation of zero; what is not finite; variables that the factors leave open.
    """
    if not isinstance(graph, gtsam.NonlinearFactorGraph) or not isinstance(values, gtsam.Values):
        raise InputError(
            f"factors are {type(graph).__name__} and {type(values).__name__}; gtsam.NonlinearFactorGraph and "
            "gtsam.Values are expected"
        )
    for k in range(graph.size()):
        _check_crosses(graph.at(k), k)
    named = keys_of(graph)
    known = present_values(named, present)
    for added in earlier:
        own = added.values()
        known.insert(part_of(own, [key for key in list(own.keys()) if not known.exists(key)]))
    _check_keys(graph, values, known, names)
    everything = part_of(known, named)
    everything.insert(values)
    _check_linear(graph, everything)
    _check_determined(graph, everything, sorted(values.keys()))
    return AddedFactors.of(range(first, first + graph.size()), graph, values)


def _check_keys(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, present: gtsam.Values, names: Collection[int]
) -> None:
    for key in list(values.keys()):
        if not is_own(key):
            letters = ", ".join(RESERVED)
            raise InputError(
                f"a value is given for {name_of(key)}; variables with the letters {letters} are the graph's"
            )
        if key in names:
            raise InputError(f"a value is given for {name_of(key)}, which was added before")
    for key in sorted(keys_of(graph)):
        if not values.exists(key) and not present.exists(key):
            needed = "no value is given for it" if is_own(key) else f"it is not {RESERVED[letter_of(key)]}"
            if key in names:
                needed = "all keyframes that it has to do with have become constant"
            raise InputError(f"unknown key {name_of(key)}: {needed}")


def _check_crosses(factor: gtsam.NonlinearFactor | None, number: int) -> None:
    alone = gtsam.NonlinearFactorGraph()
    if factor is None or isinstance(factor, gtsam.CustomFactor):
        kind = "empty" if factor is None else "a Python callback"
        raise InputError(f"factor {number} is {kind}; only factors in C++ can cross to the process of the graph")
    alone.add(factor)
    try:
        text = alone.serialize()
    except RuntimeError as error:
        raise InputError(f"factor {number}, a {type(factor).__name__}, cannot be serialised: {error}") from error
    try:
        alone.deserialize(text)
    except RuntimeError as error:  # GTSAM writes infinity, and does not read it
        raise InputError(f"factor {number}, a {type(factor).__name__}, holds a number that is not finite") from error


def _check_linear(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Factors are of the types of the values, finite, and no hard constraints, which the polish has no room for."""
    for k in range(graph.size()):
        factor, alone = graph.at(k), gtsam.NonlinearFactorGraph()
        alone.add(factor)
        name = f"factor {k}, a {type(factor).__name__}"
        try:
            error, linear = factor.error(values), alone.linearize(values)
        except (RuntimeError, ValueError, IndexError) as wrong:  # of another type, or size, in GTSAM's words
            raise InputError(f"{name}, cannot be evaluated: {str(wrong).strip()}") from wrong
        try:
            linear.hessian()
        except ValueError as wrong:  # a constraint has none
            raise InputError(f"{name}, has a standard deviation of zero; a small one is expected") from wrong
        if not np.isfinite(error):
            raise InputError(f"{name}, is not finite at the given values")


def _check_determined(graph: gtsam.NonlinearFactorGraph, everything: gtsam.Values, own: list[int]) -> None:
    """The images determine the graph's variables: what remains are the new ones, by the new factors."""
    if missing := sorted(set(own) - keys_of(graph)):
        raise InputError(f"indeterminate: no factor names {name_of(missing[0])}")
    if not own:
        return
    system = LinearSystem.of(graph, everything, own)
    derivative = system.derivative[:, : system.columns[own[-1]].stop]
    size = np.linalg.norm(derivative, axis=0)
    scaled = derivative / np.maximum(size, 1e-300)
    information, directions = np.linalg.eigh(scaled.T @ scaled)
    if information[0] < _LEAST_INFORMATION:
        worst = int(np.argmax(np.abs(directions[:, 0])))
        key = next(key for key in own if worst < system.columns[key].stop)
        raise InputError(f"indeterminate: the factors do not determine all of {name_of(key)}")
