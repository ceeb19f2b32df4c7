"""The lens: camera files, the first guess of an unknown lens, pixels and normalised coordinates.

Pixels inside the house have their centres at integers (OpenCV); those of a `pycolmap.Camera` lie at 0.5.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.errors import InputError
from factorsfm.options import GUESSED_FOCAL_STD, TOLD_FOCAL_STD

logger = logging.getLogger(__name__)

PIXEL_CENTER = 0.5  # of pycolmap's pixels; subtract it to get OpenCV's

# Between a 27 mm lens on Super 35 film and a 39 mm lens on full frame: the middle of the usual film
# lenses (18 to 50 mm on Super 35, 69 to 28 degrees), so that the guess is wrong by a factor of two at most.
GUESSED_FIELD_OF_VIEW = math.radians(50)

# Focal length over the longer side: beyond, a unit has been mistaken. A lens of 2,000 mm on Super 35 film has 80.
_FOCAL_RATIOS = (0.05, 200.0)

_RADIAL_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_RADIAL_NAMES = ("f", "fx", "fy", "cx", "cy", "k", "k1", "k2")


def read_camera(path: str | Path) -> pycolmap.Camera:
    """Read a camera from a JSON file.

    The file holds ``width, height, fx, fy, cx, cy`` in pixels with centres at integers (a PINHOLE camera), or
    ``width, height`` and ``model, params`` with the names and the order of COLMAP, principal point also with
    centres at integers. Further keys are ignored.

    Raises:
        InputError: not readable, not JSON, a key missing, or a value that is no camera's.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"camera file {path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"camera file {path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"camera file {path} holds a {type(content).__name__}; a JSON object is expected")
    try:
        return camera_from_json(content)
    except InputError as error:
        raise InputError(f"camera file {path}: {error}") from error


def open_camera(camera: str | Path | pycolmap.Camera | None) -> pycolmap.Camera | None:
    """The camera that a user means: itself, or that of a camera file.

    Raises:
        InputError: it is neither, or as in `read_camera`.
    """
    if isinstance(camera, str | Path):
        return read_camera(camera)
    if camera is not None and not isinstance(camera, pycolmap.Camera):
        raise InputError(f"the camera is of type {type(camera).__name__}; a pycolmap.Camera or a file is expected")
    return camera


def camera_to_json(camera: pycolmap.Camera) -> dict[str, Any]:
    """The content of a camera file, as `read_camera` reads it."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": float(camera.focal_length_x),
        "fy": float(camera.focal_length_y),
        "cx": float(camera.principal_point_x) - PIXEL_CENTER,
        "cy": float(camera.principal_point_y) - PIXEL_CENTER,
        "model": camera.model_name,
        "params": _shift_center(camera, -PIXEL_CENTER).tolist(),
    }


def check_camera(camera: pycolmap.Camera, width: int, height: int) -> None:
    """Insist that the camera belongs to images of this size.

    Raises:
        InputError: it has another size.
    """
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"the camera is made for {camera.width}x{camera.height} pixels, but the images have {width}x{height}"
        )


def guess_camera(width: int, height: int, image_path: Path | None = None) -> pycolmap.Camera:
    """First guess of an unknown lens: SIMPLE_PINHOLE, principal point in the middle.

    Args:
        width, height: size of the images in pixels.
        image_path: an image whose EXIF data may tell the focal length (35 mm equivalent; or focal length with
            the focal plane's resolution or with a sensor that COLMAP knows).

    Returns:
        A camera whose `has_prior_focal_length` says whether the focal length is from EXIF; otherwise the
        longer side spans 50 degrees.
    """
    longer = max(width, height)
    focal_length = _exif_focal_ratio(image_path) * longer if image_path is not None else 0.0
    known = focal_length > 0
    if not known:
        focal_length = longer / 2 / math.tan(GUESSED_FIELD_OF_VIEW / 2)
    return pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_PINHOLE",
        width=width,
        height=height,
        params=[focal_length, width / 2, height / 2],
        has_prior_focal_length=known,
    )


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


def first_focal_std(camera: pycolmap.Camera, *, given: bool) -> float:
    """How well a focal length is known before its images are seen, relative; `given`: by a camera file."""
    return TOLD_FOCAL_STD if given or camera.has_prior_focal_length else GUESSED_FOCAL_STD


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


def camera_from_json(content: Mapping[str, Any]) -> pycolmap.Camera:
    """A camera from the content of a camera file; errors as in `read_camera`."""
    width, height = (_size(content, key) for key in ("width", "height"))
    if ("model" in content) != ("params" in content):
        raise InputError('"model" and "params" go together; one of them is missing')
    if "model" in content:
        model = content["model"]
        params = _numbers(content["params"])
    else:
        model = "PINHOLE"
        params = [_number(content, key) for key in ("fx", "fy", "cx", "cy")]
    if not isinstance(model, str) or model not in set(pycolmap.CameraModelId.__members__) - {"INVALID"}:
        raise InputError(f'"model" is {model!r}; the name of a COLMAP camera model is expected')
    camera = pycolmap.Camera(
        camera_id=1, model=model, width=width, height=height, params=params, has_prior_focal_length=True
    )
    if not camera.is_perspective():
        raise InputError(f'"model" is {model}; a camera with a focal length is expected')
    if not camera.verify_params():
        raise InputError(f'"params" has {len(params)} numbers; {model} takes {camera.params_info}')
    if any(params[i] <= 0 for i in camera.focal_length_idxs()):
        raise InputError(f"the focal length in {params} is not positive")
    low, high = (ratio * max(width, height) for ratio in _FOCAL_RATIOS)
    for focal in (params[i] for i in camera.focal_length_idxs()):
        if not low <= focal <= high:
            raise InputError(
                f"the focal length is {focal:g} pixels, of images of {width}x{height}; {low:g} to {high:g} is expected"
            )
    camera.params = _shift_center(camera, PIXEL_CENTER)
    return camera


def _shift_center(camera: pycolmap.Camera, shift: float) -> NDArray[np.float64]:
    params = np.array(camera.params, dtype=np.float64)
    params[camera.principal_point_idxs()] += shift
    return params


def _size(content: Mapping[str, Any], key: str) -> int:
    value = _number(content, key)
    if not 1 <= value <= 1_000_000 or value != int(value):
        raise InputError(f'"{key}" is {value:g}; a positive whole number of pixels is expected')
    return int(value)


def _number(content: Mapping[str, Any], key: str) -> float:
    if key not in content:
        raise InputError(f'"{key}" is missing')
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f'"{key}" is {value!r}; a finite number is expected')
    return float(value)


def _numbers(values: Any) -> list[float]:
    if not isinstance(values, list):
        raise InputError(f'"params" is {values!r}; a list of numbers is expected')
    return [_number({f"params[{i}]": value}, f"params[{i}]") for i, value in enumerate(values)]


def _exif_focal_ratio(image_path: Path) -> float:
    """Focal length from EXIF over the longer side of the image, 0 if there is none to trust."""
    try:
        camera = pycolmap.infer_camera_from_image(image_path)
    except ValueError:  # an unreadable image is reported by whoever reads the frames
        return 0.0
    ratio = float(camera.mean_focal_length() / max(camera.width, camera.height))
    if not camera.has_prior_focal_length:
        return 0.0
    if not 0.2 < ratio < 30:
        logger.warning("ignoring the EXIF focal length of %s: %.3g times the image's size", image_path, ratio)
        return 0.0
    return ratio
