"""Grey images as the tracker uses them: at full and half size, and with matched exposure."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.texture import half_size, texture_of_half

Image = NDArray[np.uint8]

_GREY_LEVELS = np.arange(256)
_EXPOSURE_CHANGE = 4.0  # grey levels: mean change between two frames, below which the exposure counts as the same


class GreyFrame(NamedTuple):
    """A grey image (h, w) at two sizes.

    Attributes:
        full: (h, w) the image.
        half: (h // 2, w // 2) the image at half the size.
        histogram: (256,) of the grey levels of `half`.
    """

    full: Image
    half: Image
    histogram: NDArray[np.float32]

    @classmethod
    def of(cls, grey: Image) -> GreyFrame:
        """That of a (h, w) image."""
        half = half_size(grey)
        return cls(grey, half, cv2.calcHist([half], [0], None, [256], [0, 256]).ravel())

    @property
    def texture(self) -> float:
        """As in `TrackedFrame`."""
        return texture_of_half(self.half)


def match_exposure(previous: GreyFrame, frame: GreyFrame) -> GreyFrame:
    """The previous frame with the exposure of this one, by histogram matching; unchanged if they hardly differ."""
    counts, target = previous.histogram, frame.histogram
    matched = np.interp(np.cumsum(counts) / counts.sum(), np.cumsum(target) / target.sum(), _GREY_LEVELS)
    if counts @ np.abs(matched - _GREY_LEVELS) < _EXPOSURE_CHANGE * counts.sum():
        return previous
    table = np.rint(matched).astype(np.uint8)
    full, half = (np.asarray(cv2.LUT(image, table), np.uint8) for image in (previous.full, previous.half))
    return GreyFrame(full, half, target)
