"""Points for all tracks, triangulated from cameras that fewer tracks have given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import FIRST_SIGMA_PX
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.mapping.triangulation import Triangulation, triangulate

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TRIANGULATION_VIEWS = 10


def with_all_points(part: State, solved: State, observations: Observations, core: Index) -> State:
    """The cameras and core points of `part`, and the other points triangulated from the cameras as `solved`.

    Their places in the map are as wrong as the map was, and in another unit.
    """
    count = int(observations.point[-1]) + 1
    bearing, inverse = np.empty((count, 3)), np.empty(count)
    bearing[core], inverse[core] = part.bearing, part.inverse_distance
    others = np.setdiff1d(np.arange(count), core)
    if len(others):
        typical = float(np.median(solved.inverse_distance))
        new = triangulated(solved, observations, others, np.full(len(others), typical))
        bearing[others], inverse[others] = new.bearing, np.clip(new.inverse_distance, 0.02 * typical, 20.0 * typical)
    return replace(part, bearing=bearing, inverse_distance=inverse)


def triangulated(cameras: State, observations: Observations, points: Index, fallback: Array) -> Triangulation:
    """Some points from a few views each, spread over their tracks; `fallback` as in `triangulate`."""
    o = observations.of(points)
    start = o.first
    length = np.diff(np.append(start, len(o.point)))[o.point]
    place = np.arange(len(o.point)) - start[o.point]
    spaced = place * _TRIANGULATION_VIEWS // length > (place - 1) * _TRIANGULATION_VIEWS // length
    few = spaced | (place == length - 1)
    return triangulate(cameras, o.at(few), inlier_px=5.0, sigma=FIRST_SIGMA_PX, fallback=fallback)
