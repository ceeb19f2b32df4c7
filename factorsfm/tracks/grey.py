"""Grey images as the tracker sees them: in two sizes, with their grey levels, exposed alike, blank or not."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.patches import Image

BLANK_TEXTURE = 0.2  # grey levels
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
        half = _halved(grey)
        return cls(grey, half, cv2.calcHist([half], [0], None, [256], [0, 256]).ravel())

    @property
    def texture(self) -> float:
        """As in `TrackedFrame`."""
        return _texture(self.half)


def exposed_as(previous: GreyFrame, frame: GreyFrame) -> GreyFrame:
    """The frame before with the exposure of the present one: grey levels that have the same rank."""
    counts, target = previous.levels, frame.levels
    levels = np.interp(np.cumsum(counts) / counts.sum(), np.cumsum(target) / target.sum(), _LEVELS)
    if counts @ np.abs(levels - _LEVELS) < _EXPOSURE_CHANGE * counts.sum():
        return previous
    table = np.rint(levels).astype(np.uint8)
    full, half = (np.asarray(cv2.LUT(image, table), np.uint8) for image in (previous.full, previous.half))
    return GreyFrame(full, half, target)


def image_texture(grey: Image) -> float:
    """Texture of a (h, w) image as in `TrackedFrame`; below `BLANK_TEXTURE` it is black, white or out of focus."""
    return _texture(_halved(grey))


def _halved(grey: Image) -> Image:
    h, w = grey.shape
    return np.asarray(
        cv2.resize(grey[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8
    )


def _texture(half: Image) -> float:
    """Of the image of half the size, in grey levels of the whole."""
    # In floats: the rounding of 8 bits alone would look like texture.
    edges = cv2.Laplacian(cv2.GaussianBlur(half.astype(np.float32), (0, 0), 0.7), cv2.CV_32F)
    return float(cv2.meanStdDev(edges)[1][0, 0]) / 4
