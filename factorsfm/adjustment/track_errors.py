"""Errors that persist along a track: over many frames, a patch slides along the edge that it follows.

The error of an observation is modelled as white noise, of the same size for all tracks, and a part that stays constant
while its track passes a stretch of frames, of a size of each track's own,

    ``r = b(track, stretch) + n``,  ``b ~ N(0, tau(track)^2)``,  ``n ~ N(0, sigma^2)``.

A track that slides tells little of where the camera is, and as much as any other of its motion from frame to frame;
least squares with independent errors get both wrong. The sizes are measured on the residuals of the shot: where errors
do not persist, the cost is that of least squares with the weights of a robust kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX, coordinate_sigma, typical_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.residuals import cauchy

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STRETCH = 16  # frames: with fewer, the persistent part and the white one can hardly be told apart
_CLIP = 4.0  # standard deviations at which errors are clipped before their correlation is measured
_SHRINKAGE = 60.0  # pairs of observations that the mean over all tracks counts for


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """Weights and correlation of m residuals, sorted by point and frame.

    Attributes:
        sigma: standard deviation of the white part (pixels).
        root_weight: (m,) square root of the robust weight of each.
        first: (g,) row of the first observation of each stretch of a track; stretch: (m,) to which each belongs.
        shared: (g,) by which the outer product of a stretch's weights is reduced, the persistent part eliminated.
        persistent: (n,) standard deviation of the persistent part of each track (pixels).
    """

    sigma: float
    root_weight: Array
    first: Index
    stretch: Index
    shared: Array
    persistent: Array

    def sums(self, weighted: Array) -> Array:
        """(..., g) over each stretch of something (..., m) that is weighted already."""
        return np.asarray(np.add.reduceat(weighted * self.root_weight, self.first, axis=-1))

    def decorrelated(self, weighted: Array) -> Array:
        """(..., m) times the information matrix of the errors, of something that is weighted already."""
        common = (self.sums(weighted) * self.shared)[..., self.stretch]
        return np.asarray(weighted - self.root_weight * common)

    def cost(self, residual: Array) -> float:
        """Half the squared Mahalanobis norm of the residuals (m, 2), in units of `sigma`."""
        weighted = (residual * self.root_weight[:, None]).T
        return 0.5 * float((weighted**2).sum() - (self.sums(weighted) ** 2 * self.shared).sum())


def measure_track_errors(
    residual: Array, observations: Observations, kernel: float, known_sigma: Array | None = None
) -> TrackErrors:
    """The error model of some residuals.

    Args:
        residual: (m, 2) predicted minus observed position (pixels); observations: sorted by point and frame.
        kernel: scale of the Cauchy kernel in standard deviations of all errors.
        known_sigma: (n,) standard deviations (pixels) of the tracks of which they are known, NaN of all others; known
            errors are white, and say nothing of those of others.
    """
    o, size = observations, np.linalg.norm(residual, axis=1)
    known_sigma = np.full(int(o.point[-1]) + 1, np.nan) if known_sigma is None else known_sigma
    known = np.isfinite(known_sigma)
    measured = ~known[o.point]
    typical = coordinate_sigma(size[measured]) if measured.any() else float(np.median(known_sigma))
    next_frame = (np.diff(o.point) == 0) & (np.diff(o.frame) == 1) & measured[1:]
    jumps = np.linalg.norm(np.diff(residual, axis=0)[next_frame], axis=1)
    sigma = max(SMALLEST_SIGMA_PX, min(typical, typical_sigma(jumps) / np.sqrt(2.0))) if len(jumps) else typical

    key = o.point * (int(o.frame.max()) // STRETCH + 1) + o.frame // STRETCH
    begins = np.append(True, np.diff(key) != 0)
    first, stretch = np.nonzero(begins)[0], np.cumsum(begins) - 1
    count = np.diff(np.append(first, len(key)))
    # Of independent errors, the products of two have the mean zero.
    clipped = residual * np.minimum(1.0, _CLIP * typical / np.maximum(size, 1e-9))[:, None]
    products = 0.5 * (np.add.reduceat(clipped, first) ** 2 - np.add.reduceat(clipped**2, first)).sum(1)
    track = o.point[first]
    common, pairs = np.bincount(track, products), np.bincount(track, count * (count - 1.0))
    usual = max(0.0, float(common[~known].sum() / max(pairs[~known].sum(), 1.0)))
    persistent = np.where(known, 0.0, np.maximum(0.0, (_SHRINKAGE * usual + common) / (_SHRINKAGE + pairs)))

    of_all = np.where(known, known_sigma, typical)[o.point]
    weight = cauchy(residual / of_all[:, None], kernel)[1]
    weight[~measured] *= (sigma / of_all[~measured]) ** 2
    ratio = persistent[track] / sigma**2
    shared = ratio / (1.0 + ratio * np.add.reduceat(weight, first))
    return TrackErrors(sigma, np.sqrt(weight), first, stretch, shared, np.sqrt(persistent))
