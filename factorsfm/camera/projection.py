"""The lens: camera files, the first guess of an unknown lens, pixels and normalised coordinates.

Pixels inside the house have their centres at integers (OpenCV); those of a `pycolmap.Camera` lie at 0.5.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.support.errors import InputError

PIXEL_CENTER = 0.5  # of pycolmap's pixels; subtract it to get OpenCV's
_RADIAL_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_RADIAL_NAMES = ("f", "fx", "fy", "cx", "cy", "k", "k1", "k2")


def normalized_from_pixels(camera: pycolmap.Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undistorted image coordinates (x/z, y/z), (n, 2), of pixels with centres at integers, (n, 2).

    NaN where the lens model cannot be inverted.
    """
    pixels = np.asarray(xy, dtype=np.float64).reshape(-1, 2) + PIXEL_CENTER
    return np.asarray(camera.cam_from_img(pixels), dtype=np.float64)


def pixels_from_normalized(camera: pycolmap.Camera, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels with centres at integers, (n, 2), of undistorted image coordinates (x/z, y/z), (n, 2)."""
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    rays = np.column_stack([uv, np.ones(len(uv))])
    return np.asarray(camera.img_from_cam(rays), dtype=np.float64) - PIXEL_CENTER


def with_focal(camera: pycolmap.Camera, focal: float) -> pycolmap.Camera:
    """The same camera with another mean focal length (pixels)."""
    estimated = pycolmap.Camera(camera.todict())
    ratio = focal / (0.5 * (camera.focal_length_x + camera.focal_length_y))
    for index in camera.focal_length_idxs():
        params = estimated.params
        params[index] *= ratio
        estimated.params = params
    return estimated


def lens_shape(camera: pycolmap.Camera) -> NDArray[np.float64]:
    """(4,) distortion of a camera as in `factors.distort`, from which an estimate of it starts.

    Raises:
        InputError: its model has more to it than radial distortion.
    """
    names = [name.strip() for name in camera.params_info.split(",")]
    values = dict(zip(names, camera.params, strict=True))
    more = [name for name in names if name not in _RADIAL_NAMES and values[name] != 0]
    if more or camera.model_name not in _RADIAL_MODELS:
        raise InputError(
            f"a lens of the model {camera.model_name} was to be estimated{' with ' + more[0] if more else ''}; "
            f"one of {', '.join(_RADIAL_MODELS)} without tangential distortion is expected"
        )
    return np.array([values.get("k1", values.get("k", 0.0)), values.get("k2", 0.0), 0.0, 0.0])


def with_lens(camera: pycolmap.Camera, focal: float, shape: NDArray[np.float64]) -> pycolmap.Camera:
    """The same camera with another mean focal length (pixels) and (4,) distortion as in `factors.distort`.

    RADIAL, or OPENCV where the pixels are not square.
    """
    scaled = with_focal(camera, focal)
    fx, fy = scaled.focal_length_x, scaled.focal_length_y
    center = [scaled.principal_point_x + fx * shape[2], scaled.principal_point_y + fy * shape[3]]
    k = shape[:2].tolist()
    params = [fx, *center, *k] if fx == fy else [fx, fy, *center, *k, 0.0, 0.0]
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model="RADIAL" if fx == fy else "OPENCV",
        width=camera.width,
        height=camera.height,
        params=params,
        has_prior_focal_length=camera.has_prior_focal_length,
    )
