"""The size of the errors of tracks, and their correlation within blocks of the image and of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FIRST_SIGMA_PX = 0.25  # of a tracked point, until it is measured
SMALLEST_SIGMA_PX = 0.03  # no track is better than this
_BLOCKS = (8, 5, 16)  # across, down, frames: in which errors may be correlated


def typical_sigma(errors: Array, share: float = 0.5) -> float:
    """Standard deviation of a coordinate, from the lengths (n,) of 2-D errors with outliers.

    Args:
        share: of the errors, the smallest ones, that are none of outliers.
    """
    return float(np.quantile(errors, share) / np.sqrt(-2.0 * np.log(1.0 - share)))


def coordinate_sigma(errors: Array, share: float = 0.5) -> float:
    """`typical_sigma`, but no better than tracks can be."""
    return max(typical_sigma(errors, share), SMALLEST_SIGMA_PX)


def block_inflation(residual: Array, frame: NDArray[np.int64], place: Array) -> float:
    """Factor on the variance because errors of neighbouring tracks in neighbouring frames are correlated.

    In a block of the image and of time, independent errors add up to the root of their number.

    Args:
        residual: (m, 2) predicted minus observed position; frame: (m,) in which; place: (m, 2) normalised coordinates.
    """
    of_sums, power, _ = _block_powers(residual, frame, place)
    return max(1.0, of_sums / max(power, 1e-12))


def shared_sigma(residual: Array, frame: NDArray[np.int64], place: Array) -> float:
    """Standard deviation of the part of an error that the neighbours have, too; in the unit of the residuals.

    From all pairs of a block: unlike `block_inflation`, it does not grow with the number of observations in a block.

    Args:
        residual, frame, place: see `block_inflation`.
    """
    of_sums, power, pairs = _block_powers(residual, frame, place)
    return float(np.sqrt(max(of_sums - power, 0.0) / max(2 * pairs, 1)))  # two coordinates


def _block_powers(residual: Array, frame: NDArray[np.int64], place: Array) -> tuple[float, float, int]:
    """Power of the sums of the inliers in all blocks, of the inliers one by one, and number of pairs within blocks."""
    inlier = _inliers(residual)
    across, down, frames = _BLOCKS
    key = (frame // frames) * down * across + image_cells(place, across, down)
    key, residual = key[inlier], residual[inlier]
    sums = [np.bincount(key, residual[:, axis]) for axis in range(2)]
    count = np.bincount(key)
    return float((sums[0] ** 2 + sums[1] ** 2).sum()), float((residual**2).sum()), int((count * (count - 1)).sum())


def image_cells(xy: Array, across: int, down: int) -> NDArray[np.int64]:
    """(n,) cell of each position (n, 2) in a grid over what they fill, numbered row by row."""
    low, high = xy.min(0), xy.max(0)
    cell = (0.999 * (xy - low) / np.maximum(high - low, 1e-9) * [across, down]).astype(np.int64)
    return np.asarray(cell[:, 1] * across + cell[:, 0])


def _inliers(residual: Array) -> NDArray[np.bool_]:
    size = np.linalg.norm(residual, axis=1)
    return np.asarray(size < 3.0 * np.median(size))
