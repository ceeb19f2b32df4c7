"""How much texture an image has."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

BLANK_TEXTURE = 0.2  # grey levels


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
