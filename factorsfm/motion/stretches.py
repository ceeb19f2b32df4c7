"""What the camera does by stretches of a shot: it stands, then turns, then moves.

Each stretch is judged as a shot of its own. One that is too short to show a slow motion is not said to be without one:
neighbours without visible translation are judged again together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.some_frames import seen_in
from factorsfm.motion.shot_kind import CLEAR_GAIN, Motion, classify_motion
from factorsfm.support.options import PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]

_Value = TypeVar("_Value")

_SHORTEST = 0.5  # seconds of a stretch, in which the slowest moves of a camera in use can be seen
_ITERATIONS = 3  # until the poses of a stretch are at their best for it alone
_FEW = 4  # frames of a stretch that are asked first
_MOST_BLOCKS = 24  # of a long shot, which then has longer ones


@dataclass(frozen=True, slots=True)
class Stretch:
    """Frames of one kind of motion, to half of the shortest stretch at either end.

    Attributes:
        first, last: numbers of the frames.
    """

    first: int
    last: int
    kind: ShotKind


def stretches(solved: BundleAdjustment, whole: Motion, seconds: Array, options: PolishOptions) -> list[Stretch]:
    """The kinds of motion of a shot in order, by rows of its frames; one stretch where it is of one kind throughout.

    Args:
        solved: converged over cameras and points; whole: motion of the whole shot.
        seconds: (k,) of its frames, ascending.
    """
    frames = len(solved.state.rotation)
    length = (seconds[-1] - seconds[0]) * frames / max(frames - 1, 1)  # until the frame after the last would come
    blocks = min(int(round(length / _SHORTEST, 6)), frames // _FEW, _MOST_BLOCKS)
    if blocks < 2 or whole.kind is ShotKind.STATIC:
        return [Stretch(0, frames - 1, whole.kind)]
    edges = np.linspace(0, frames, blocks + 1).astype(int).tolist()

    def kind_of(first: int, end: int) -> ShotKind:
        """Of some blocks, up to the first frame after them; none of a shot that only turns translates."""
        if (first, end) == (0, blocks):
            return whole.kind
        kind = _kind_of_frames(solved, edges[first], min(edges[end] + 1, frames), options)
        return ShotKind.ROTATION if kind is ShotKind.GENERAL and whole.kind is ShotKind.ROTATION else kind

    kinds = [kind_of(block, block + 1) for block in range(blocks)]
    kinds = _again_together(kinds, lambda kind: kind is not ShotKind.GENERAL, kind_of)
    kinds = _again_together(kinds, lambda kind: kind is ShotKind.STATIC, kind_of)
    return [Stretch(edges[first], edges[end] - 1, kind) for first, end, kind in _runs(kinds)]


def _again_together(
    kinds: list[ShotKind], weak: Callable[[ShotKind], bool], kind_of: Callable[[int, int], ShotKind]
) -> list[ShotKind]:
    """The kinds of blocks, where runs of weak ones together are not weak any more."""
    kinds = list(kinds)
    for first, end, alone in _runs([weak(kind) for kind in kinds]):
        if alone and end - first > 1 and not weak(together := kind_of(first, end)):
            kinds[first:end] = [together] * (end - first)
    return kinds


def _runs(values: list[_Value]) -> list[tuple[int, int, _Value]]:
    """First place, the place after the last one, and value of each run of equal values."""
    runs: list[tuple[int, int, _Value]] = []
    first = 0
    for value, run in groupby(values):
        end = first + len(list(run))
        runs.append((first, end, value))
        first = end
    return runs


def _kind_of_frames(solved: BundleAdjustment, first: int, end: int, options: PolishOptions) -> ShotKind:
    """Of the frames from one to before another, by themselves; where a few of them move clearly, they all do."""
    few = _alone(solved, np.unique(np.linspace(first, end - 1, _FEW).astype(int)), options)
    if few is not None and classify_motion(few, options).gain > CLEAR_GAIN:
        return ShotKind.GENERAL
    alone = _alone(solved, np.arange(first, end), options)
    if alone is None:
        return ShotKind.STATIC
    if (kind := classify_motion(alone, options).kind) is ShotKind.GENERAL:  # even with the poses of the whole shot
        return kind
    alone.solve(_ITERATIONS)
    return classify_motion(alone, options).kind


def _alone(solved: BundleAdjustment, frames: NDArray[np.int64], options: PolishOptions) -> BundleAdjustment | None:
    """Some frames (ascending) with the poses of the whole shot, None where no two of them see the same point."""
    seen, points = seen_in(frames, solved.observations)
    if not len(points):
        return None
    state = solved.state.seen_from(int(frames[0])).of(points).in_frames(frames)
    return BundleAdjustment(state, seen, options, solved.errors)
