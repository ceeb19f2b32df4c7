"""Between a `pycolmap.Camera` and the unknowns of its lens: focal length, radial distortion and principal point."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import with_focal
from factorsfm.support.errors import InputError

_RADIAL_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_RADIAL_NAMES = ("f", "fx", "fy", "cx", "cy", "k", "k1", "k2")


def distortion_of(camera: pycolmap.Camera) -> NDArray[np.float64]:
    """Where the estimate of a camera's distortion starts: (4,) k1, k2, 0, 0, as in `adjustment.residuals.distort`.

    Raises:
        InputError: the camera's model has more than radial distortion.
    """
    names = [name.strip() for name in camera.params_info.split(",")]
    values = dict(zip(names, camera.params, strict=True))
    other = [name for name in names if name not in _RADIAL_NAMES and values[name] != 0]
    if other or camera.model_name not in _RADIAL_MODELS:
        raise InputError(
            f"the lens model {camera.model_name}{f' with {other[0]}' if other else ''} cannot be estimated; "
            f"one of {', '.join(_RADIAL_MODELS)} without tangential distortion is expected"
        )
    return np.array([values.get("k1", values.get("k", 0.0)), values.get("k2", 0.0), 0.0, 0.0])


def with_distortion(camera: pycolmap.Camera, focal: float, distortion: NDArray[np.float64]) -> pycolmap.Camera:
    """The same camera with another focal length and distortion: RADIAL, or OPENCV where its pixels are not square.

    Args:
        focal: mean focal length, pixels.
        distortion: (4,) k1, k2 and the displacement of the principal point in focal lengths, as in
            `adjustment.residuals.distort`.
    """
    scaled = with_focal(camera, focal)
    fx, fy = scaled.focal_length_x, scaled.focal_length_y
    k1, k2, right, down = distortion[:4].tolist()
    center = [scaled.principal_point_x + fx * right, scaled.principal_point_y + fy * down]
    params = [fx, *center, k1, k2] if fx == fy else [fx, fy, *center, k1, k2, 0.0, 0.0]
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model="RADIAL" if fx == fy else "OPENCV",
        width=camera.width,
        height=camera.height,
        params=params,
        has_prior_focal_length=camera.has_prior_focal_length,
    )
