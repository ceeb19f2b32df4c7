"""The sparse map: a position for every track that has one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.residuals import camera_points
from factorsfm.mapping.mapped_images import MappedImage

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


class PointMap:
    """World positions by track id."""

    def __init__(self, points: Array | None = None) -> None:
        self._points = np.full((1024, 3), np.nan) if points is None else points.copy()

    def contains(self, ids: Index) -> Mask:
        """Which of the tracks have a position."""
        inside = ids < len(self._points)
        found = np.zeros(len(ids), bool)
        found[inside] = np.isfinite(self._points[ids[inside], 0])
        return found

    def at(self, ids: Index) -> Array:
        """(n, 3) positions of tracks that have one."""
        return self._points[ids]

    def set(self, ids: Index, points: Array) -> None:
        """Add or move points."""
        while len(ids) and ids.max() >= len(self._points):
            self._points = np.concatenate([self._points, np.full_like(self._points, np.nan)])
        self._points[ids] = points

    def remove(self, ids: Index) -> None:
        """Forget the positions of some tracks."""
        self._points[ids[ids < len(self._points)]] = np.nan

    def keep(self, ids: Index) -> None:
        """Forget the positions of all other tracks; ids may repeat."""
        others = np.ones(len(self._points), bool)
        others[ids[ids < len(self._points)]] = False
        self._points[others] = np.nan

    def copy(self) -> PointMap:
        """An independent copy."""
        return PointMap(self._points)

    def scaled(self, unit: float) -> PointMap:
        """An independent copy with all lengths `unit` times as long."""
        return PointMap(unit * self._points)

    def part(self, ids: Index) -> PointMap:
        """An independent copy that holds no other tracks than these."""
        ids = ids[self.contains(ids)]
        part = PointMap()
        part.set(ids, self.at(ids))
        return part

    def __reduce__(self) -> tuple[Any, ...]:
        return _filled, self.all()

    @property
    def table(self) -> Array:
        """Positions by track id, NaN where there is none."""
        return self._points

    def all(self) -> tuple[Index, Array]:
        """Track ids (ascending) and positions of all points."""
        ids = np.nonzero(np.isfinite(self._points[:, 0]))[0]
        return ids, self._points[ids]

    def inverse_depths(self, image: MappedImage, rows: Mask) -> Array:
        """Inverse depths of mapped tracks in an image, 0 behind its camera."""
        z = self._seen_from(image, image.tracks.ids[rows])[:, 2]
        return np.where(z > 1e-6, 1.0 / np.maximum(z, 1e-6), 0.0)

    def _seen_from(self, image: MappedImage, ids: Index) -> Array:
        points = self.at(ids)
        return camera_points(*image.pose, points, np.ones(len(points)))


def _filled(ids: Index, points: Array) -> PointMap:
    filled = PointMap()
    filled.set(ids, points)
    return filled
