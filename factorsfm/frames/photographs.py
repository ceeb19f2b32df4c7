"""Photographs beside the camera with which they were solved: that of a set has one format and size."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def lies_otherwise(size: tuple[int, ...], camera: pycolmap.Camera) -> bool:
    """Whether an image (width, height) is upright and the format of a camera is not, or the reverse."""
    return bool((size[0] - size[1]) * (camera.width - camera.height) < 0)


def turned_left(image: Image) -> Image:
    """An image that lies otherwise than its camera, as it is solved."""
    return np.asarray(cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8)


def in_format_of(camera: pycolmap.Camera, image: Image) -> Image:
    """A photograph turned and scaled to the format and size of its camera; one of another aspect ratio as it is."""
    if lies_otherwise(image.shape[1::-1], camera):
        image = turned_left(image)
    height, width = image.shape[:2]
    if (width, height) == (camera.width, camera.height) or abs(width * camera.height - height * camera.width) > max(
        camera.width, camera.height
    ):
        return image
    smaller = width > camera.width
    size, method = (camera.width, camera.height), cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)
