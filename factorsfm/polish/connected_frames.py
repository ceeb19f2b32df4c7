"""Which frames are connected: those that share enough points with the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations

Index = NDArray[np.int64]


def connected_frames(
    observations: Observations, frames: int, least: int, worth: Index
) -> tuple[NDArray[np.bool_], Index]:
    """The largest set of frames in which each observes at least so many points that others of the set observe, too.

    The cameras of other frames are not determined relative to these.

    Args:
        frames: how many there are.
        worth: (points,) for how many points each counts.

    Returns:
        (frames,) whether each belongs to the set; (frames,) how many of the set's points it observes, by their worth.
    """
    count = np.bincount(observations.frame, minlength=frames)
    largest, shared = np.zeros(frames, bool), np.zeros_like(count)
    left = np.ones(frames, bool)
    while left.sum() > max(1, largest.sum()):
        first = int(np.argmax(np.where(left, count, -1)))
        part, seen = _grown(observations, np.arange(frames) == first, least, worth)
        if part.sum() > max(1, largest.sum()):
            largest, shared = part, seen
        left &= ~part
    return largest, shared


def _grown(o: Observations, part: NDArray[np.bool_], least: int, worth: Index) -> tuple[NDArray[np.bool_], Index]:
    """As `connected_frames`, the set that grows from some frames: others join it by the points that it observes."""
    while True:
        known = np.zeros(int(o.point.max(initial=-1)) + 1, bool)
        known[o.point[part[o.frame]]] = True
        mine = known[o.point]
        seen = np.bincount(o.frame[mine], worth[o.point[mine]], minlength=len(part)).astype(np.int64)
        grown = part | (seen >= least)
        if (grown == part).all():
            return part, seen
        part = grown
