"""How much texture an image has, and whether it is blank."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

BLANK_TEXTURE = 0.2  # grey levels: with less texture an image is black, white or out of focus
_FEATURE_SIGMA = 0.7  # pixels of the image of half the size


def image_texture(grey: Image) -> float:
    """Texture of a (h, w) image, see `texture_of_half`."""
    return texture_of_half(half_size(grey))


def half_size(grey: Image) -> Image:
    """A (h, w) image at half the size, by averaging; an odd last row or column is left out."""
    h, w = grey.shape
    return np.asarray(
        cv2.resize(grey[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8
    )


def texture_of_half(half: Image) -> float:
    """Texture of an image from its `half_size`: standard deviation of the Laplacian at the scale of a feature.

    It is in grey levels of the full image.
    """
    # In floats, because rounding to 8 bits looks like texture.
    edges = cv2.Laplacian(cv2.GaussianBlur(half.astype(np.float32), (0, 0), _FEATURE_SIGMA), cv2.CV_32F)
    return float(cv2.meanStdDev(edges)[1][0, 0]) / 4
