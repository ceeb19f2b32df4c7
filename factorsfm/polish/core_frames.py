"""Long shots: cameras, lens and motion are solved on few frames, on whose points the other frames follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.polish.pose_on_points import poses_on_points
from factorsfm.support.options import MapperOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# The time of a solution grows with the square of their number, and there are many: from several starts, through several
# lenses, with and without translation. More frames hardly make lens and motion more certain, since the errors of tracks
# persist from one to the next. Cameras alone, through a known lens, need still fewer: all are solved again at the end.
_FRAMES, _FRAMES_ALONE = 60, 40
_CLEARLY_FEWER = 1.25  # times as many frames as that: fewer save nothing, since all of them have to follow
_IN_COMMON = 0.25  # of the tracks of a frame, which the one before it sees, too: a hundred and more


def core_frames(observations: Observations, frames: int, *, alone: bool) -> Index:
    """Rows of the fewest frames of a shot, evenly spread, each of which sees enough of what the one before does.

    Where the view is lost, all frames together do not see enough of what they did before either.

    Args:
        alone: whether neither lens nor shutter is estimated with them.
    """
    lost = _in_common(observations, np.arange(frames)) < _IN_COMMON
    limit = _FRAMES_ALONE if alone else _FRAMES
    while _CLEARLY_FEWER * limit < frames:
        rows = np.linspace(0, frames - 1, limit).astype(int)
        enough = _in_common(observations, rows) >= _IN_COMMON
        if (enough | np.logical_or.reduceat(lost, rows[:-1])).all():
            return rows
        limit *= 2
    return np.arange(frames)


def _in_common(observations: Observations, rows: Index) -> Array:
    """Share of the tracks of each of some frames but the first, which the previous one of these sees, too."""
    o = observations
    keep = np.isin(o.frame, rows)
    frame, point = np.searchsorted(rows, o.frame[keep]), o.point[keep]  # sorted by point, and by frame there
    follows = (np.diff(point) == 0) & (np.diff(frame) == 1)
    common = np.bincount(frame[1:][follows], minlength=len(rows))[1:]
    return np.asarray(common / np.maximum(np.bincount(frame, minlength=len(rows))[1:], 1))


def in_all_frames(
    solved: State, rows: Index, seen: Observations, group: Index, turns: Array,
    *, moves: bool, sigma: float, options: MapperOptions,
) -> State:  # fmt: skip
    """The solution with all frames, those that it has not from its points.

    Args:
        solved: on some frames; rows: of these among all.
        seen: its points in all frames; group: (k,) as `State.group` of all frames.
        turns, moves, sigma: as in `poses_on_points`.
    """
    rotation, translation = np.empty((len(group), 3, 3)), np.empty((len(group), 3))
    rotation[rows], translation[rows] = solved.rotation, solved.translation
    cameras = replace(solved, group=group)
    between = poses_on_points(solved, rows, seen, cameras, turns, moves=moves, sigma=sigma, options=options)
    for found in between:
        rotation[found.row], translation[found.row] = found.pose
    return replace(cameras, rotation=rotation, translation=translation, world=int(rows[solved.world]))
