"""The image motion between two frames, as a field of affine maps, from the tracks in both."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.parts import Array

_GRID_CELLS = 24  # along the longer image side
_SMOOTHING_CELLS = 1.5  # standard deviation of the Gaussian that weighs the tracks around a cell
_AFFINE_TRACKS = 0.3  # weight of tracks: a cell with much less moves by a pure translation
_MEAN_TRACKS = 0.01  # weight of tracks: a cell with much less moves as the whole image does


class LocalMotion:
    """An affine regression of the motion in each cell of a grid, with more weight for tracks near the cell.

    The sums of the regression are formed in each cell; one blur of the grid weighs the sums of its neighbours.

    Args:
        old, new: (n, 2) pixels of the tracks in the previous frame and in this one.
        shape: (h, w) of the image.
    """

    def __init__(self, old: Array, new: Array, shape: tuple[int, ...]) -> None:
        h, w = shape[:2]
        self._cell = max(h, w) / _GRID_CELLS
        self._size = int(np.ceil(w / self._cell)), int(np.ceil(h / self._cell))
        gw, gh = self._size
        p, u = old.astype(np.float64), (new - old).astype(np.float64)
        self._mean = u.mean(0) if len(u) else np.zeros(2)
        u = u - self._mean
        x, y = (p / self._cell).T
        columns = [np.ones_like(x), x, y, x * x, x * y, y * y]
        columns += [u[:, 0], u[:, 0] * x, u[:, 0] * y, u[:, 1], u[:, 1] * x, u[:, 1] * y]
        index = self._index(p)
        sums = np.stack([np.bincount(index, c, gw * gh) for c in columns], -1)
        grid = sums.astype(np.float64).reshape(gh, gw, -1)
        grid = cv2.GaussianBlur(grid, (0, 0), _SMOOTHING_CELLS, borderType=cv2.BORDER_CONSTANT).reshape(gh * gw, -1)
        s1, sx, sy, sxx, sxy, syy, u0, u0x, u0y, v0, v0x, v0y = grid.T
        s1 = np.maximum(s1, 1e-12)
        mx, my = sx / s1, sy / s1
        cxx, cxy, cyy = sxx / s1 - mx * mx, sxy / s1 - mx * my, syy / s1 - my * my
        ridge = _AFFINE_TRACKS / s1
        cxx, cyy = cxx + ridge, cyy + ridge
        det = cxx * cyy - cxy * cxy
        self._linear = np.empty((gh * gw, 2, 2))
        for row, (m0, m0x, m0y) in enumerate(((u0, u0x, u0y), (v0, v0x, v0y))):
            bx, by = m0x / s1 - m0 / s1 * mx, m0y / s1 - m0 / s1 * my
            self._linear[:, row, 0] = (cyy * bx - cxy * by) / det / self._cell
            self._linear[:, row, 1] = (cxx * by - cxy * bx) / det / self._cell
        share = s1 / (s1 + _MEAN_TRACKS)
        self._shift = self._mean + share[:, None] * np.stack([u0, v0], -1) / s1[:, None]
        self._center = np.stack([mx, my], -1) * self._cell

    def linear(self, xy: Array) -> Array:
        """(n, 2, 2) linear part of the map from the previous frame to this one, at pixels (n, 2) of the previous."""
        return np.asarray(np.eye(2) + self._linear[self._index(xy)], np.float32)

    def at(self, xy: Array) -> Array:
        """(n, 2) motion in pixels, at pixels (n, 2) of the previous frame."""
        index = self._index(xy)
        away = np.where(self._shift[index] == self._mean, 0.0, xy - self._center[index])
        return np.asarray(self._shift[index] + np.einsum("nij,nj->ni", self._linear[index], away), np.float32)

    def _index(self, xy: NDArray[np.floating]) -> NDArray[np.int64]:
        """(n,) number of the cell at pixels (n, 2)."""
        cell = np.minimum((xy / self._cell).astype(np.int64), np.array(self._size) - 1)
        return np.asarray(cell[:, 1] * self._size[0] + cell[:, 0])
