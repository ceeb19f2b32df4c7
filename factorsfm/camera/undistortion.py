"""Images without distortion: the pinhole camera that takes them, and where its pixels are in the distorted image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER, without_distortion

Array = NDArray[np.float64]

# Models that equal a pinhole if all parameters besides focal length and principal point are 0.
_PINHOLE_IF_ZERO = frozenset({"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})
_SAME = 1e-3  # pixels; two points closer than that are one


def distorts(camera: pycolmap.Camera) -> bool:
    """Whether the lens has distortion."""
    return camera.model_name not in _PINHOLE_IF_ZERO or bool(np.any(camera.params[camera.extra_params_idxs()]))


def filled_pinhole(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A pinhole with the same focal lengths, of the size that the distorted image fills without empty rims."""
    if not distorts(camera):
        return without_distortion(camera)
    return without_distortion(pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera))


def pixel_grid(camera: pycolmap.Camera) -> Array:
    """(h * w, 2) centres of all pixels, row by row, from the image's corner."""
    x, y = np.meshgrid(np.arange(camera.width) + PIXEL_CENTER, np.arange(camera.height) + PIXEL_CENTER)
    return np.column_stack([x.ravel(), y.ravel()])


def distorted_places(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> Array:
    """(h, w, 2) position in the image of a camera of each pixel of a pinhole beside it, in pixels from the corner.

    NaN beyond the angle up to which the lens model is invertible.
    """
    rays = np.asarray(pinhole.cam_from_img(pixel_grid(pinhole)), np.float64)
    places = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])), np.float64)
    back = np.asarray(camera.cam_from_img(places), np.float64)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    places[~(np.abs(back - rays) * focal < _SAME).all(axis=1)] = np.nan
    return places.reshape(pinhole.height, pinhole.width, 2)


class Straightening:
    """Images of a camera as a pinhole at the same place sees them.

    Args:
        camera: of the images; pinhole: of the new images.
    """

    def __init__(self, camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> None:
        outside = -float(max(camera.width, camera.height))
        places = np.nan_to_num(distorted_places(camera, pinhole), nan=outside) - PIXEL_CENTER
        self._x, self._y = np.asarray(np.moveaxis(places, -1, 0), np.float32)

    def image(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """(h, w, 3) by cubic interpolation, black where the footage has nothing."""
        light = pixels.astype(np.float32) if pixels.dtype == np.float16 else pixels  # OpenCV knows no half
        return np.asarray(self._remapped(light, cv2.INTER_CUBIC).astype(pixels.dtype))

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(h, w) by the nearest pixel, False where the footage has nothing."""
        return np.asarray(self._remapped(mask.astype(np.uint8), cv2.INTER_NEAREST), bool)

    def _remapped(self, image: NDArray[Any], interpolation: int) -> NDArray[Any]:
        return np.asarray(cv2.remap(image, self._x, self._y, interpolation, borderMode=cv2.BORDER_CONSTANT))
