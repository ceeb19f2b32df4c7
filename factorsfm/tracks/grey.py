"""Grey images as the tracker sees them: in two sizes, with their grey levels, exposed alike, blank or not."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.texture import half_size, texture_of_half
from factorsfm.tracks.patches import Image

_LEVELS = np.arange(256)
_EXPOSURE_CHANGE = 4.0  # mean change of the grey levels between frames, with which it is made good


class GreyFrame(NamedTuple):
    """An image (h, w), and the same in half the size.

    Attributes:
        levels: (256,) how often each grey level occurs in `half`.
    """

    full: Image
    half: Image
    levels: NDArray[np.float32]

    @classmethod
    def of(cls, grey: Image) -> GreyFrame:
        """Of a whole image."""
        half = half_size(grey)
        return cls(grey, half, cv2.calcHist([half], [0], None, [256], [0, 256]).ravel())

    @property
    def texture(self) -> float:
        """As in `TrackedFrame`."""
        return texture_of_half(self.half)


def exposed_as(previous: GreyFrame, frame: GreyFrame) -> GreyFrame:
    """The frame before with the exposure of the present one: grey levels that have the same rank."""
    counts, target = previous.levels, frame.levels
    levels = np.interp(np.cumsum(counts) / counts.sum(), np.cumsum(target) / target.sum(), _LEVELS)
    if counts @ np.abs(levels - _LEVELS) < _EXPOSURE_CHANGE * counts.sum():
        return previous
    table = np.rint(levels).astype(np.uint8)
    full, half = (np.asarray(cv2.LUT(image, table), np.uint8) for image in (previous.full, previous.half))
    return GreyFrame(full, half, target)
