"""Pixels and undistorted normalised image coordinates of a camera.

Pixels in this package have their centres at integers (OpenCV); those of a `pycolmap.Camera` have them at 0.5.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

PIXEL_CENTER = 0.5  # of pycolmap's pixels; subtract it to get OpenCV's


def normalized_from_pixels(camera: pycolmap.Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undistorted normalised image coordinates (x/z, y/z) of pixels.

    Args:
        xy: (n, 2) pixels, centres at integers.

    Returns:
        (n, 2), NaN where the lens model cannot be inverted.
    """
    pixels = np.asarray(xy, dtype=np.float64).reshape(-1, 2) + PIXEL_CENTER
    return np.asarray(camera.cam_from_img(pixels), dtype=np.float64)


def pixels_from_normalized(camera: pycolmap.Camera, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2) pixels, centres at integers, of (n, 2) undistorted normalised image coordinates (x/z, y/z)."""
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    rays = np.column_stack([uv, np.ones(len(uv))])
    return np.asarray(camera.img_from_cam(rays), dtype=np.float64) - PIXEL_CENTER


def without_distortion(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A pinhole with the same focal lengths and principal point."""
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[
            camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y,
        ],
        has_prior_focal_length=camera.has_prior_focal_length,
    )  # fmt: skip


def with_focal(camera: pycolmap.Camera, focal: float) -> pycolmap.Camera:
    """The same camera with another mean focal length (pixels)."""
    scaled = pycolmap.Camera(camera.todict())
    ratio = focal / (0.5 * (camera.focal_length_x + camera.focal_length_y))
    for index in camera.focal_length_idxs():
        params = scaled.params
        params[index] *= ratio
        scaled.params = params
    return scaled
