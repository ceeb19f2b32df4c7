"""Poses, affines and landmarks of a map, as factors of the caller's name them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap

Array = NDArray[np.float64]


class MapContents:
    """Poses, affines and landmarks of a map by frame and track."""

    def __init__(self, keyframes: Sequence[MappedImage], points: PointMap) -> None:
        self._images = {image.tracks.frame: image for image in keyframes if image.registered}
        self._points = points

    def pose(self, frame: int) -> tuple[Array, Array] | None:
        """`cam_from_world` of a keyframe."""
        return self._images[frame].pose if frame in self._images else None

    def affine(self, frame: int) -> tuple[float, float] | None:
        """Scale and shift of a keyframe's depth prior."""
        return self._images[frame].affine if frame in self._images else None

    def landmark(self, track: int) -> Array | None:
        """(3,) position of a point."""
        ids = np.array([track])
        return self._points.at(ids)[0] if self._points.contains(ids)[0] else None
