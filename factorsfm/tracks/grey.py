"""Grey images as the tracker uses them: at full size and reduced, and with matched exposure."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.texture import half_size, texture_of_half

Image = NDArray[np.uint8]
T = TypeVar("T", np.float32, np.float64)

_GREY_LEVELS = np.arange(256)
_EXPOSURE_CHANGE = 4.0  # grey levels: mean change between two frames, below which the exposure counts as the same
# Motion is sought in an image whose longer side has no more pixels. Larger ones are halved until it does: their finest
# detail adds nothing to what brings a track near its place, which the birth patch then finds in the full image.
_LONGEST_SIDE_PX = 1280


class GreyFrame(NamedTuple):
    """A grey image (h, w) at several sizes.

    Attributes:
        full: (h, w) the image.
        reduced: (h // scale, w // scale) the image in which motion is sought.
        scale: pixels of `full` in one of `reduced` along a side, a power of 2.
        half: `reduced` at half its size.
        histogram: (256,) of the grey levels of `half`.
    """

    full: Image
    reduced: Image
    scale: int
    half: Image
    histogram: NDArray[np.float32]

    @classmethod
    def of(cls, grey: Image) -> GreyFrame:
        """That of a (h, w) image."""
        reduced, scale = reduced_image(grey)
        half = half_size(reduced)
        return cls(grey, reduced, scale, half, cv2.calcHist([half], [0], None, [256], [0, 256]).ravel())

    @property
    def texture(self) -> float:
        """As in `TrackedFrame`."""
        return texture_of_half(self.half)


def reduced_image(grey: Image) -> tuple[Image, int]:
    """An image (h, w) halved until it is small enough to seek motion in it, and how many pixels became one."""
    scale = 1
    while max(grey.shape) > _LONGEST_SIDE_PX:
        grey, scale = half_size(grey), 2 * scale
    return grey, scale


def at_scale(xy: NDArray[T], scale: int) -> NDArray[T]:
    """Pixels (n, 2), centres at integers, of an image that is `scale` times smaller."""
    return np.asarray((xy - (scale - 1) / 2) / scale, xy.dtype)


def at_full_size(xy: NDArray[T], scale: int) -> NDArray[T]:
    """The inverse of `at_scale`."""
    return np.asarray(xy * scale + (scale - 1) / 2, xy.dtype)


def match_exposure(previous: GreyFrame, frame: GreyFrame) -> GreyFrame:
    """The previous frame reduced with the exposure of this one, by histogram matching.

    It is unchanged if they hardly differ; the full image always is, since no motion is sought in it.
    """
    counts, target = previous.histogram, frame.histogram
    matched = np.interp(np.cumsum(counts) / counts.sum(), np.cumsum(target) / target.sum(), _GREY_LEVELS)
    if counts @ np.abs(matched - _GREY_LEVELS) < _EXPOSURE_CHANGE * counts.sum():
        return previous
    table = np.rint(matched).astype(np.uint8)
    reduced, half = (np.asarray(cv2.LUT(image, table), np.uint8) for image in (previous.reduced, previous.half))
    return previous._replace(reduced=reduced, half=half, histogram=target)
