"""Small grey copies of frames, cut into blocks, and how alike they are.

Blocks are looked up by normalised correlation, which a change of exposure leaves alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_LONGER_SIDE = 96  # of the small copy, pixels; all lengths below are in its pixels
_BLOCK = 18
_NEAR = 9  # how far a block may move by itself
_FAR = 0.35  # how far all blocks may move together, share of the image
_SPREAD = 3  # how far a block may be off the common displacement: parallax, rotation, zoom
_OVERLAP = 0.6  # share of the blocks that must still be in view after the common displacement
_TEXTURE = 2.0  # grey levels, standard deviation in a block; with less it shows nothing to compare
_FEWEST = 0.1  # share of the blocks that must show texture in both, else there is nothing to compare
_SAME_VIEW = 0.06  # dissimilarity below which there is no need to look farther
_BLEND_BLOCKS = 0.3  # share of the blocks that must show texture in all of three frames
_BLEND_REACH = 3  # how far a block may move in a dissolve


@dataclass(frozen=True, slots=True)
class View:
    """Small grey copy of a frame, cut into a grid of blocks.

    Attributes:
        pixels: (h, w).
        deviation: (h, w) standard deviation of the block with this upper left corner, never below `_TEXTURE`.
        corners: (n, 2) x, y of the upper left corners of the blocks in the grid.
        blocks: (n, block height, block width) of mean 0, divided by their standard deviation and number of pixels.
        textured: (n,) whether the block shows something.
    """

    pixels: Array
    deviation: Array
    corners: NDArray[np.int64]
    blocks: Array
    textured: NDArray[np.bool_]

    @property
    def contrast(self) -> float:
        """Mean standard deviation in a block, grey levels."""
        return float(self.deviation.mean())

    @staticmethod
    def of(image: NDArray[np.uint8]) -> View:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        scale = _LONGER_SIDE / max(grey.shape)
        width, height = (max(1, round(side * scale)) for side in grey.shape[::-1])
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small - small.mean(), (3, 3), 0)  # near 0 squares lose no digits
        size = (min(_BLOCK, width), min(_BLOCK, height))
        mean = cv2.boxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        square = cv2.sqrBoxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        deviation = np.sqrt(np.maximum(square - mean**2, _TEXTURE**2))
        corners = np.array([(x, y) for y in _grid(height) for x in _grid(width)])
        x, y = corners.T
        blocks = _normalized(small, corners, size[::-1], deviation[y, x])
        return View(small, deviation, corners, blocks, deviation[y, x] > _TEXTURE)

    def at(self, corners: NDArray[np.int64]) -> Array:
        """What the blocks would be with these upper left corners."""
        x, y = corners.T
        return _normalized(self.pixels, corners, self.blocks.shape[1:], self.deviation[y, x])


def _normalized(pixels: Array, corners: NDArray[np.int64], size: tuple[int, ...], deviation: Array) -> Array:
    height, width = size
    cut = np.stack([pixels[y : y + height, x : x + width] for x, y in corners])
    return np.asarray((cut - cut.mean(axis=(1, 2), keepdims=True)) / (deviation[:, None, None] * width * height))


def _grid(length: int) -> range:
    """Where the blocks begin along a side."""
    count = max(1, length // _BLOCK)
    first = max(0, (length - count * _BLOCK) // 2)
    return range(first, first + count * _BLOCK, _BLOCK)


def dissimilarity(first: View, second: View) -> float:
    """One minus the correlation of the blocks of `first` with what is found of them in `second`."""
    usable = np.flatnonzero(first.textured & second.textured)
    if len(usable) < _FEWEST * len(first.blocks):
        return 1.0
    near = _correlations(first, second, usable, _NEAR, _NEAR)
    alone = 1.0 - float(np.median(near.max(axis=(1, 2))))
    if alone < _SAME_VIEW:  # the usual case
        return max(alone, 0.0)
    height, width = first.pixels.shape
    far = _correlations(first, second, usable, round(_FAR * width), round(_FAR * height))
    inside = np.isfinite(far)
    seen = inside.sum(axis=0)
    kernel = np.ones((2 * _SPREAD + 1, 2 * _SPREAD + 1), np.uint8)
    spread = np.stack([cv2.dilate(each, kernel) for each in far])
    mean = np.where(inside, spread, 0.0).sum(axis=0) / np.maximum(seen, 1)
    together = 1.0 - float(mean[seen >= _OVERLAP * len(usable)].max(initial=0.0))
    return min(alone, together)


def blend(first: View, middle: View, last: View) -> tuple[float, float]:
    """How much better a weighted sum of two frames, as in a dissolve, explains one between them than the better one.

    Each block of the middle frame is compared with its place in the others, a few pixels around included.

    Returns:
        Medians over the blocks of the share of the variance, 0 to 1, that the better one of the two explains alone, and
        that their sum explains; both 1 where there is too little texture.
    """
    usable = np.flatnonzero(middle.textured)
    if len(usable) < _BLEND_BLOCKS * len(middle.blocks):
        return 1.0, 1.0
    ends = (first, last)
    found = [_correlations(middle, end, usable, _BLEND_REACH, _BLEND_REACH) for end in ends]
    best = np.array([correlations.max(axis=(1, 2)) for correlations in found])
    alone = np.clip(best, 0.0, 1.0).max(axis=0) ** 2
    together = alone.copy()
    for one, other in ((0, 1), (1, 0)):
        # What one of them shows at its best place, and how that correlates with the other, place by place.
        places = found[one].reshape(len(usable), -1).argmax(axis=1)
        corners = middle.corners[usable] + np.column_stack(np.divmod(places, 2 * _BLEND_REACH + 1)[::-1]) - _BLEND_REACH
        shown = ends[one].at(corners)
        between = _lookup(shown, middle.corners[usable], ends[other], _BLEND_REACH, _BLEND_REACH)
        c, d = best[one][:, None, None], found[other]
        with np.errstate(invalid="ignore"):
            rest = np.maximum(1.0 - between**2, 0.1)
            weights = (c - d * between) / rest, (d - c * between) / rest
            explained = np.where((weights[0] > 0) & (weights[1] > 0), weights[0] * c + weights[1] * d, 0.0)
        together = np.maximum(together, np.nan_to_num(explained).max(axis=(1, 2)))
    return float(np.median(alone)), float(np.median(np.minimum(together, 1.0)))


def _correlations(first: View, second: View, chosen: NDArray[np.int64], reach_x: int, reach_y: int) -> Array:
    """Of chosen blocks of `first` with `second` at all displacements within reach.

    Returns:
        (blocks, 2 reach_y + 1, 2 reach_x + 1); minus infinity where the block would leave the image.
    """
    return _lookup(first.blocks[chosen], first.corners[chosen], second, reach_x, reach_y)


def _lookup(blocks: Array, corners: NDArray[np.int64], view: View, reach_x: int, reach_y: int) -> Array:
    """Correlations of normalised blocks with a view around these corners, as of `_correlations`."""
    found = np.full((len(blocks), 2 * reach_y + 1, 2 * reach_x + 1), -np.inf, np.float32)
    height, width = view.pixels.shape
    block_height, block_width = blocks.shape[1:]
    for correlations, block, (x, y) in zip(found, blocks, corners, strict=True):
        left, right = max(0, x - reach_x), min(width - block_width, x + reach_x) + 1
        top, bottom = max(0, y - reach_y), min(height - block_height, y + reach_y) + 1
        window = view.pixels[top : bottom + block_height - 1, left : right + block_width - 1]
        covariance = cv2.matchTemplate(window, block, cv2.TM_CCORR)
        inside = (slice(top - y + reach_y, bottom - y + reach_y), slice(left - x + reach_x, right - x + reach_x))
        correlations[inside] = covariance / view.deviation[top:bottom, left:right]
    return found
