"""The depth of one image: a map of values, looked up at keypoints, and how reliable it is there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorsfm.support.errors import InputError

_EDGE_WINDOW = 0.015  # side of the window in which a depth edge is looked for, as a share of the image width
# Range of the inverse depth in that window over the spread of the whole map: below the first it is a slope, above the
# second an edge.
_SLOPE_RANGE, _EDGE_RANGE = 0.08, 0.25
_LEAST_SPREAD = 0.02  # of a map over its median: a flatter map is noise and has no edges
_SPREAD_SAMPLES = 100_000  # number of pixels, about, from which the spread of a map is measured


class DepthKind(StrEnum):
    """What the values of a depth map are."""

    INVERSE = "inverse"  # inverse depth up to scale and shift, large = near
    DEPTH = "depth"  # z-depth in an unknown unit
    METRIC = "metric"  # z-depth in metres


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth of one image. The map covers the whole image at any resolution.

    Attributes:
        values: (h, w) float32; NaN where the value given is 0, negative, infinite or NaN.
        kind: what the values are.

    Raises:
        InputError: `values` is not a 2-D array with at least one element, or `kind` is unknown.
    """

    values: NDArray[np.float32]
    kind: DepthKind

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.size == 0:
            raise InputError(f"a depth map must be a 2-D array, not one of shape {self.values.shape}")
        with np.errstate(over="ignore"):
            values = np.asarray(self.values, dtype=np.float32)
        valid = np.isfinite(values) & (values >= np.finfo(np.float32).tiny)  # below, 1 / value overflows
        object.__setattr__(self, "kind", depth_kind(self.kind))
        object.__setattr__(self, "values", np.where(valid, values, np.float32(np.nan)))

    def inverse_depth(
        self, xy: ArrayLike, image_size: tuple[int, int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Inverse depth at keypoints, and its reliability.

        The values of the map are interpolated bilinearly; depths are inverted after that.

        Args:
            xy: (n, 2) keypoints in pixels of the image, centres at integers.
            image_size: (width, height) of the image.

        Returns:
            (n,) inverse depth, NaN outside the image and beside invalid values; (n,) reliability in 0..1: 1 away from
            depth edges, 0 on them and where the depth is NaN.
        """
        values, reliability = self._look_up(xy, image_size)
        return (values if self.kind is DepthKind.INVERSE else 1.0 / values), reliability

    def depth(self, xy: ArrayLike, image_size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Depth at keypoints, and its reliability; arguments and shapes as in `inverse_depth`."""
        values, reliability = self._look_up(xy, image_size)
        return (1.0 / values if self.kind is DepthKind.INVERSE else values), reliability

    @cached_property
    def reliability(self) -> NDArray[np.float32]:
        """(h, w) in 0..1: 1 away from depth edges, 0 on them and where the map is invalid.

        The range (largest minus smallest) of the inverse depth in a window of 1.5 % of the image width is divided by
        the spread of the map, the distance between the 5th and the 95th percentile of its inverse depth. The
        reliability falls linearly from 1 at a ratio of 0.08 to 0 at 0.25. It does not depend on scale and shift of the
        inverse depth, unless the map is nearly flat.
        """
        inverse = self.values if self.kind is DepthKind.INVERSE else np.float32(1.0) / self.values
        valid = np.isfinite(inverse)
        if not valid.any():
            return np.zeros(inverse.shape, dtype=np.float32)
        samples = inverse[valid]
        low, median, high = np.percentile(samples[:: 1 + samples.size // _SPREAD_SAMPLES], (5, 50, 95))
        spread = max(high - low, _LEAST_SPREAD * median)
        side = max(3, 2 * round(_EDGE_WINDOW * inverse.shape[1] / 2) + 1)
        window = np.ones((side, side), dtype=np.uint8)
        highest = cv2.dilate(np.where(valid, inverse, samples.min()), window)
        lowest = cv2.erode(np.where(valid, inverse, samples.max()), window)
        ratio = (highest - lowest) / spread
        reliability = np.clip((_EDGE_RANGE - ratio) / (_EDGE_RANGE - _SLOPE_RANGE), 0.0, 1.0)
        return np.where(valid, reliability, 0.0).astype(np.float32)

    def _look_up(self, xy: ArrayLike, image_size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        size = np.array(image_size, dtype=np.float64)
        inside = np.all((points >= -0.5) & (points <= size - 0.5), axis=1)
        map_size = np.array(self.values.shape[::-1])
        # Rounded, so that no rounding error gives weight to the neighbour of a pixel.
        on_map = np.round((np.where(inside[:, None], points, 0.0) + 0.5) * (map_size / size) - 0.5, 6)
        on_map = np.clip(on_map, 0, map_size - 1)
        values = _bilinear(self.values, on_map)
        values[~inside] = np.nan
        reliability = _bilinear(self.reliability, on_map)
        reliability[~np.isfinite(values)] = 0.0
        return values, reliability


def _bilinear(array: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) values at points (n, 2) inside the array; NaN if a neighbour of non-zero weight is NaN."""
    height, width = array.shape
    x0, y0 = np.floor(xy).astype(np.intp).T
    fx, fy = (xy - np.floor(xy)).T
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    neighbours = np.array([array[y0, x0], array[y0, x1], array[y1, x0], array[y1, x1]], dtype=np.float64)
    result: NDArray[np.float64] = np.sum(weights * np.where(weights > 0, neighbours, 0.0), axis=0)
    return result


def depth_kind(kind: DepthKind | str) -> DepthKind:
    """The depth kind of this name.

    Raises:
        InputError: there is none.
    """
    try:
        return DepthKind(kind)
    except ValueError:
        raise InputError(f"no depth kind {kind!r}: expected {', '.join(DepthKind)}") from None
