"""How different two frames are, by block matching between small grey copies of them.

Blocks are compared by normalised correlation, which a change of exposure does not affect.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Lengths are in pixels of the small copy, unless they say otherwise.
_LONGER_SIDE = 96
_BLOCK = 18
_OWN_REACH = 9  # largest displacement of a block by itself
_SLOW_REACH, _HARDLY_CHANGED = 2, 0.02  # the same that is tried first, and the dissimilarity below which it is enough
_COMMON_REACH = 0.35  # largest displacement common to all blocks, as a share of the image
_PARALLAX = 3  # how far a block may be off the common displacement: parallax, rotation, zoom
_OVERLAP = 0.6  # share of the blocks that must be in view after the common displacement
_TEXTURE = 2.0  # grey levels: a block with a smaller standard deviation has nothing to compare
_LEAST_TEXTURED = 0.1  # share of the blocks that must have texture in both frames
_SAME_VIEW = 0.06  # dissimilarity below which the common displacement need not be searched
_LEAST_TEXTURED_DISSOLVE = 0.3  # share of the blocks of the middle frame that must have texture
_DISSOLVE_REACH = 3  # largest displacement of a block in a dissolve


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small grey copy of a frame, cut into a grid of n blocks.

    Attributes:
        pixels: (h, w) grey levels minus their mean.
        deviation: (h, w) standard deviation of the block with this upper left corner, at least `_TEXTURE`.
        corners: (n, 2) x, y of the upper left corners of the blocks.
        blocks: (n, block height, block width) with mean 0, divided by their standard deviation and number of pixels.
        textured: (n,) whether the block has texture.
    """

    pixels: Array
    deviation: Array
    corners: NDArray[np.int64]
    blocks: Array
    textured: NDArray[np.bool_]

    @property
    def contrast(self) -> float:
        """Mean standard deviation of a block, grey levels."""
        return float(self.deviation.mean())

    @staticmethod
    def of(image: NDArray[np.uint8]) -> Thumbnail:
        """That of an image, (h, w, 3) BGR or (h, w) grey."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        scale = _LONGER_SIDE / max(grey.shape)
        width, height = (max(1, round(side * scale)) for side in grey.shape[::-1])
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small - small.mean(), (3, 3), 0)  # without the mean, squares keep their precision
        size = (min(_BLOCK, width), min(_BLOCK, height))
        mean = cv2.boxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        square = cv2.sqrBoxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        deviation = np.sqrt(np.maximum(square - mean**2, _TEXTURE**2))
        corners = np.array([(x, y) for y in _grid(height) for x in _grid(width)])
        x, y = corners.T
        blocks = _normalized(small, corners, size[::-1], deviation[y, x])
        return Thumbnail(small, deviation, corners, blocks, deviation[y, x] > _TEXTURE)

    def blocks_at(self, corners: NDArray[np.int64]) -> Array:
        """The normalised blocks with these upper left corners, (n, block height, block width)."""
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


def dissimilarity(first: Thumbnail, second: Thumbnail) -> float:
    """One minus the correlation of the blocks of `first` with their best matches in `second`, 0 to 1.

    Matches are searched in two ways: each block by itself in its neighbourhood, and all blocks with one displacement in
    the whole image. The smaller result counts.
    """
    usable = np.flatnonzero(first.textured & second.textured)
    if len(usable) < _LEAST_TEXTURED * len(first.blocks):
        return 1.0
    by_themselves = 1.0
    for reach, enough in ((_SLOW_REACH, _HARDLY_CHANGED), (_OWN_REACH, _SAME_VIEW)):  # a longer search is seldom needed
        near = _correlations(first, second, usable, reach, reach)
        by_themselves = 1.0 - float(np.median(near.max(axis=(1, 2))))
        if by_themselves < enough:
            return max(by_themselves, 0.0)
    height, width = first.pixels.shape
    far = _correlations(first, second, usable, round(_COMMON_REACH * width), round(_COMMON_REACH * height))
    inside = np.isfinite(far)
    in_view = inside.sum(axis=0)
    kernel = np.ones((2 * _PARALLAX + 1, 2 * _PARALLAX + 1), np.uint8)
    best_nearby = np.stack([cv2.dilate(each, kernel) for each in far])
    mean = np.where(inside, best_nearby, 0.0).sum(axis=0) / np.maximum(in_view, 1)
    together = 1.0 - float(mean[in_view >= _OVERLAP * len(usable)].max(initial=0.0))
    return min(by_themselves, together)


def dissolve_variances(first: Thumbnail, middle: Thumbnail, last: Thumbnail) -> tuple[float, float]:
    """How much of the middle frame the two others explain: one of them alone, and a weighted sum as in a dissolve.

    Each block of the middle frame is compared with its place in the others and a few pixels around it.

    Returns:
        Medians over the blocks of the share of variance, 0 to 1, that the better of the two frames explains alone, and
        that their weighted sum explains; both 1 where there is too little texture.
    """
    usable = np.flatnonzero(middle.textured)
    if len(usable) < _LEAST_TEXTURED_DISSOLVE * len(middle.blocks):
        return 1.0, 1.0
    ends = (first, last)
    found = [_correlations(middle, end, usable, _DISSOLVE_REACH, _DISSOLVE_REACH) for end in ends]
    best = np.array([correlations.max(axis=(1, 2)) for correlations in found])
    alone = np.clip(best, 0.0, 1.0).max(axis=0) ** 2
    together = alone.copy()
    for one, other in ((0, 1), (1, 0)):
        # Regression of a block of the middle frame on its best match in one end and on every place in the other end:
        # c and d are its correlations with these two, `between` is their correlation with each other.
        places = found[one].reshape(len(usable), -1).argmax(axis=1)
        offsets = np.column_stack(np.divmod(places, 2 * _DISSOLVE_REACH + 1)[::-1]) - _DISSOLVE_REACH
        matched = ends[one].blocks_at(middle.corners[usable] + offsets)
        between = _search(matched, middle.corners[usable], ends[other], _DISSOLVE_REACH, _DISSOLVE_REACH)
        c, d = best[one][:, None, None], found[other]
        with np.errstate(invalid="ignore"):
            rest = np.maximum(1.0 - between**2, 0.1)
            weights = (c - d * between) / rest, (d - c * between) / rest
            explained = np.where((weights[0] > 0) & (weights[1] > 0), weights[0] * c + weights[1] * d, 0.0)
        together = np.maximum(together, np.nan_to_num(explained).max(axis=(1, 2)))
    return float(np.median(alone)), float(np.median(np.minimum(together, 1.0)))


def _correlations(first: Thumbnail, second: Thumbnail, chosen: NDArray[np.int64], reach_x: int, reach_y: int) -> Array:
    """Correlations of n chosen blocks of `first` with `second` at all displacements within reach, see `_search`."""
    return _search(first.blocks[chosen], first.corners[chosen], second, reach_x, reach_y)


def _search(blocks: Array, corners: NDArray[np.int64], thumbnail: Thumbnail, reach_x: int, reach_y: int) -> Array:
    """Correlations of n normalised blocks with a thumbnail, at all displacements from their corners within reach.

    Returns:
        (n, 2 reach_y + 1, 2 reach_x + 1); minus infinity where the block would leave the image.
    """
    found = np.full((len(blocks), 2 * reach_y + 1, 2 * reach_x + 1), -np.inf, np.float32)
    height, width = thumbnail.pixels.shape
    block_height, block_width = blocks.shape[1:]
    for correlations, block, (x, y) in zip(found, blocks, corners, strict=True):
        left, right = max(0, x - reach_x), min(width - block_width, x + reach_x) + 1
        top, bottom = max(0, y - reach_y), min(height - block_height, y + reach_y) + 1
        window = thumbnail.pixels[top : bottom + block_height - 1, left : right + block_width - 1]
        covariance = cv2.matchTemplate(window, block, cv2.TM_CCORR)
        inside = (slice(top - y + reach_y, bottom - y + reach_y), slice(left - x + reach_x, right - x + reach_x))
        correlations[inside] = covariance / thumbnail.deviation[top:bottom, left:right]
    return found
