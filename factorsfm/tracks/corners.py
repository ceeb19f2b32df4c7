"""Where new tracks start: the strongest corners that are free, spread over the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.options import TrackerOptions
from factorsfm.tracks.grey import GreyFrame, at_scale

Array = NDArray[np.float32]

_GRID_CELLS = 24  # along the longer image side


def new_corners(
    frame: GreyFrame,
    occupied: Array,
    avoided: Array,
    mask: NDArray[np.bool_] | None,
    count: int,
    options: TrackerOptions,
) -> Array:
    """The strongest Shi-Tomasi corners away from what is occupied, from every cell of a grid in turn.

    Corners are sought in an image of half the size or less, since it does not matter where exactly a patch lies.

    Args:
        occupied: (n, 2) pixels of the tracks alive; a new one keeps its distance to them.
        avoided: (m, 2) pixels of places whose window new tracks must not touch.
        mask: (h, w), True where no track may start.
        count: most corners.

    Returns:
        (k, 2) pixels, centres at integers.
    """
    image, scale = (frame.reduced, frame.scale) if frame.scale > 1 else (frame.half, 2)
    h, w = image.shape
    border = -(-options.border_px // scale)
    free = np.zeros((h, w), np.uint8)
    free[border : h - border, border : w - border] = 255
    if mask is not None:
        for k in range(scale):
            free[mask[k : scale * h : scale, k : scale * w : scale]] = 0
    distance = max(2, round(0.4 * (w * h / options.max_tracks) ** 0.5))
    for xy, radius in ((occupied, distance), (avoided, options.window_px // scale)):
        for x, y in at_scale(xy, scale).round().astype(int).tolist():
            cv2.circle(free, (x, y), radius, 0, -1)
    corners = cv2.goodFeaturesToTrack(image, 0, options.corner_quality, distance, mask=free, blockSize=3)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    middle = (scale - 1) // 2  # the pixel of the full image there, or beside the middle of four
    return _spread(scale * np.rint(corners[:, 0]) + np.float32(middle), count, frame.full.shape)


def _spread(corners: Array, count: int, shape: tuple[int, ...]) -> Array:
    """`count` of the corners, taken in turn from the cells of a grid; corners come strongest first."""
    if len(corners) <= count:
        return corners
    cell_px = max(shape[:2]) / _GRID_CELLS
    cell = (corners // cell_px).astype(int)
    key = cell[:, 1] * (_GRID_CELLS + 1) + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[0, np.nonzero(np.diff(key[order]))[0] + 1]
    rank_in_cell = np.arange(len(key)) - np.repeat(first, np.diff(np.r_[first, len(key)]))
    turn = np.empty(len(key), int)
    turn[order] = rank_in_cell
    return corners[np.argsort(turn, kind="stable")[:count]]
