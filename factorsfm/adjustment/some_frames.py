"""A part of a problem that shows at a fraction of the cost what all of it would: few frames, evenly spread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State

Index = NDArray[np.int64]

_FRAMES = 24


def some_frames(state: State, observations: Observations) -> tuple[Index, State, Observations]:
    """Few frames, evenly spread, that of the world among them: their rows, and the points that two of them see."""
    count = len(state.rotation)
    frames = np.unique([*np.linspace(0, count - 1, min(count, _FRAMES)).astype(int), state.world])
    few, points = seen_in(frames, observations)
    return frames, state.of(points).in_frames(frames), few


def on_some_frames(adjustment: BundleAdjustment) -> BundleAdjustment:
    """Cameras and points of a solution on few frames, with the same noise."""
    _, state, few = some_frames(adjustment.state, adjustment.observations)
    return BundleAdjustment(state, few, adjustment.options, adjustment.errors)


def seen_in(frames: Index, observations: Observations) -> tuple[Observations, Index]:
    """What is observed in some of the frames (ascending), of the points that two of them see; and these points."""
    keep = np.isin(observations.frame, frames)
    seen = np.bincount(observations.point[keep], minlength=int(observations.point.max(initial=-1)) + 1) >= 2
    keep &= seen[observations.point]
    points = np.flatnonzero(seen)
    frame, point = observations.frame[keep], observations.point[keep]
    few = observations.at(keep, frame=np.searchsorted(frames, frame), point=np.searchsorted(points, point))
    return few, points
