"""Depth guidance of the incremental steps: the prior of single images beside the map as it stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.gather import sightings
from factorsfm.adjustment.observations import PriorObservations
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.priors.affine import fit_affine
from factorsfm.support.options import MapperOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LEAST_POINTS = 10  # mapped points from which scale and shift are fitted
_UNKNOWN_SPREAD = 0.3  # relative error of a prior that cannot be compared with the map yet
_SMALLEST_SPREAD = 0.05  # no network is believed more than this


class DepthGuidance:
    """Scale and shift of each image, and what the prior says of new points.

    An image's affine is (a, b) of ``d = a / z + b``; with the paper's residual (gamma, beta) of ``z = gamma D + beta``.
    """

    def __init__(self, options: MapperOptions, points: PointMap) -> None:
        self.options = options
        self.points = points
        self._paper = "paper" in (options.registration_depth, options.triangulation_depth)

    def fit(self, image: MappedImage) -> None:
        """Scale and shift from the mapped points that the image sees, unless registration gave them."""
        depth = image.tracks.depth
        if depth is None or image.affine is not None:
            return
        use = self.points.contains(image.tracks.ids) & depth.valid
        inverse = self.points.inverse_depths(image, use)
        front = inverse > 1e-6
        if front.sum() < _LEAST_POINTS:
            return
        measured, inverse = depth.inverse_depth[use][front], inverse[front]
        if self._paper:
            image.affine = fit_affine(1.0 / measured, 1.0 / inverse)[:2]
        else:
            image.affine = fit_affine(inverse, measured, free_shift=depth.free_shift)[:2]

    def sigma(self, image: MappedImage, keyframes: int) -> float:
        """Standard deviation of the prior at a point: the robust spread of its residuals, inflated by the number of
        keyframes that repeat the same error.
        """
        depth = image.tracks.depth
        assert depth is not None
        assert image.affine is not None
        use = self.points.contains(image.tracks.ids) & depth.valid
        spread = _UNKNOWN_SPREAD
        if use.sum() >= _LEAST_POINTS:
            scale, shift = image.affine
            residual = scale * self.points.inverse_depths(image, use) + shift - depth.inverse_depth[use]
            spread = 1.4826 * float(np.median(np.abs(residual)))
        return max(spread, _SMALLEST_SPREAD) * float(np.sqrt(1.0 + keyframes))

    def fallback(self, image: MappedImage, ids: Index) -> Array:
        """(n,) inverse distances where the views leave them open: from the image's prior, else the map's median."""
        inverse = self.points.inverse_depths(image, self.points.contains(image.tracks.ids))
        typical = float(np.median(inverse)) if len(inverse) else 1.0
        fallback = np.full(len(ids), typical)
        depth = image.tracks.depth
        if depth is not None and image.affine is not None and self.options.triangulation_depth != "none":
            at = np.searchsorted(image.tracks.ids, ids)
            use = depth.valid[at]
            guess = self._inverse_depth(depth.inverse_depth[at][use], image.affine)
            fallback[use] = np.clip(guess, 0.1 * typical, 10.0 * typical)
        return fallback

    def _inverse_depth(self, measured: Array, affine: tuple[float, float]) -> Array:
        """World inverse depth that the prior says."""
        if self._paper:
            return 1.0 / np.maximum(affine[0] / measured + affine[1], 1e-3)
        return (measured - affine[1]) / affine[0]

    def at_observations(
        self, images: Sequence[MappedImage], ids: Index
    ) -> tuple[Array | None, PriorObservations | None]:
        """The prior for the triangulation of some tracks, scale and shift fixed (paper, section 3.3)."""
        guided = [k for k, i in enumerate(images) if i.tracks.depth is not None and i.affine is not None]
        if self.options.triangulation_depth == "none" or not guided:
            return None, None
        frame, point, _ = sightings([images[k].tracks for k in guided], ids)
        value, sigma = np.empty(len(point)), np.empty(len(point))
        affine = np.empty((len(guided), 2))
        for row, k in enumerate(guided):
            image, mine = images[k], frame == row
            depth = image.tracks.depth
            assert depth is not None
            assert image.affine is not None
            at = np.searchsorted(image.tracks.ids, ids[point[mine]])
            measured = np.where(depth.valid[at], depth.inverse_depth[at], np.nan)
            if self._paper:  # lambda (z - gamma D - beta)^2, to first order in the inverse depth
                value[mine] = self._inverse_depth(measured, image.affine)
                sigma[mine] = value[mine] ** 2 / np.sqrt(self.options.depth_weight)
                affine[row] = 1.0, 0.0
            else:
                value[mine], sigma[mine] = measured, self.sigma(image, len(guided))
                affine[row] = image.affine
        good = np.isfinite(value)
        if not good.any():
            return None, None
        n = int(good.sum())
        return affine, PriorObservations(
            frame[good], np.array(guided)[frame[good]], point[good],
            value[good], sigma[good], np.zeros((n, 4), np.int64), np.zeros((n, 4)), np.eye(1), 1.0, 1.0,
        )  # fmt: skip
