"""The ground at right angles to a known up: the lowest level on which many points lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.alignment.planes import TOLERANCE
from factorsfm.result.reconstruction import Reconstruction

Array = NDArray[np.float64]

_LEAST_SHARE, _FEWEST = 0.02, 15  # of the points must lie on a ground
_BELOW = 0.05  # share of the points that may lie clearly below a ground: more are below a table
_ABOVE, _UNDER = 1.3, 6.0  # times as many points as just above it, walls have as many; as just below, it is opaque
_BREADTH = 0.12  # of the points on it across their longest direction: the foot of one wall is no ground
_LEVELS = 400  # that are tried
_SLOPED_DEGREES = 0.5  # by which a ground may slope without being seen to


@dataclass(frozen=True, slots=True)
class Ground:
    """A level ground.

    Attributes:
        height: above the world's origin along up; std: of the height of the first camera above it. Units.
        points: (n,) rows of the points on it.
    """

    height: float
    std: float
    points: NDArray[np.int64]


def level_ground(result: Reconstruction, up: Array, up_std: float) -> Ground | None:
    """The ground below the cameras, None where too few points lie on one.

    Args:
        up: (3,) unit vector; up_std: its standard deviation, degrees.
    """
    centers = result.camera_centers()
    rows = np.flatnonzero(np.isfinite(result.points).all(axis=1))
    if not len(rows) or not len(centers):
        return None
    points = result.points[rows] - centers.mean(axis=0)
    height, tolerance = points @ up, TOLERANCE * np.linalg.norm(points, axis=1)
    for level in _levels(height, tolerance):
        on = np.flatnonzero(np.abs(height - level) < tolerance)
        level = float(np.median(height[on]))
        on = np.flatnonzero(np.abs(height - level) < tolerance)
        if _is_ground(points, height, tolerance, up, level, on):
            middle = points[on].mean(axis=0) + centers.mean(axis=0)
            # Points that are wrong alike: the spread counts for a few of them, not for all.
            spread = 1.4826 * float(np.median(np.abs(height[on] - level))) / np.sqrt(min(len(on), _FEWEST))
            away = middle - centers[0]
            away = float(np.linalg.norm(away - (away @ up) * up))
            std = np.hypot(spread, away * np.radians(np.hypot(up_std, _SLOPED_DEGREES)))
            return Ground(level + float(centers.mean(axis=0) @ up), float(std), rows[on])
    return None


def _levels(height: Array, tolerance: Array) -> Array:
    """Levels below the cameras with enough points, the lowest of each crowd's best first."""
    below = np.sort(height[height < 0])
    levels = below[:: max(1, len(below) // _LEVELS)]
    if not len(levels):
        return np.asarray(levels)
    count = (np.abs(height[:, None] - levels) < tolerance[:, None]).sum(axis=0)
    enough = count >= max(_FEWEST, _LEAST_SHARE * len(height))
    # The best level within a tolerance of it: one at the rim of a crowd has part of its points only.
    reach = float(np.median(tolerance))
    best = np.array([count[k] == count[np.abs(levels - levels[k]) <= reach].max() for k in range(len(levels))])
    return np.asarray(levels[enough & best])


def _is_ground(points: Array, height: Array, tolerance: Array, up: Array, level: float, on: NDArray[np.int64]) -> bool:
    if len(on) < max(_FEWEST, _LEAST_SHARE * len(height)):
        return False
    if np.mean(height - level < -2 * tolerance) > _BELOW:
        return False
    above, under = (np.count_nonzero(np.abs(height - level - k * tolerance) < tolerance) for k in (3, -3))
    if len(on) < max(_ABOVE * above, _UNDER * under):
        return False
    flat = points[on] - points[on].mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    spread = np.linalg.svd(flat, compute_uv=False)
    return bool(spread[1] >= _BREADTH * spread[0])
