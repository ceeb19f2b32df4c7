"""Camera files: JSON with the names of OpenCV or COLMAP, and lens files of other programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.other_files import content_of
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.support.errors import InputError

# Smallest and largest focal length over the longer image side; one outside has the wrong unit, such as millimetres.
# A 2,000 mm lens on Super 35 film has a ratio of 80.
_FOCAL_RATIOS = (0.05, 200.0)

_SAME_ASPECT = 0.01  # relative: a calibrated pixel aspect is not exactly the nominal one
# Models with one focal length: those of the same lenses with two, and how many of their last parameters are 0 then.
_TWO_FOCAL_LENGTHS = {
    "SIMPLE_PINHOLE": ("PINHOLE", 0),
    "SIMPLE_RADIAL": ("OPENCV", 3),
    "RADIAL": ("OPENCV", 2),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 3),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 2),
}


def read_camera(path: str | Path) -> pycolmap.Camera:
    """Read a camera from a JSON file, or from a lens file of another program.

    The JSON file holds ``width, height, fx, fy, cx, cy`` in pixels (a PINHOLE camera), or ``width, height`` and
    ``model, params`` with the names and the order of COLMAP. Pixel centres are at integers in both forms. Further keys
    are ignored. Other files are OpenCV's YAML or XML of a calibration, COLMAP's ``cameras.txt``, and samples of
    OpenTrackIO.

    Raises:
        InputError: the file cannot be read, a key is missing, or a value is out of range.
    """
    path = Path(path)
    try:
        content = content_of(path)
        if not isinstance(content, dict):
            raise InputError(f"it holds a {type(content).__name__}; a JSON object is expected")
        return camera_from_json(content)
    except InputError as error:
        raise InputError(f"camera file {path}: {error}") from error


def open_camera(camera: str | Path | pycolmap.Camera | None) -> pycolmap.Camera | None:
    """The camera given as a `pycolmap.Camera`, or as the path of a camera file; None stays None.

    Raises:
        InputError: it is neither, or as in `read_camera`.
    """
    if isinstance(camera, str | Path):
        return read_camera(camera)
    if camera is not None and not isinstance(camera, pycolmap.Camera):
        raise InputError(f"the camera is of type {type(camera).__name__}; a pycolmap.Camera or a file is expected")
    return camera


def camera_to_json(camera: pycolmap.Camera) -> dict[str, Any]:
    """The content of a camera file that `read_camera` reads."""
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
    """Check that the camera has the size of the images, in pixels.

    Raises:
        InputError: it has another size.
    """
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"the camera is made for {camera.width}x{camera.height} pixels, but the images have {width}x{height}"
        )


def fitted_camera(camera: pycolmap.Camera, width: int, height: int, pixel_aspect: float) -> pycolmap.Camera:
    """The camera for images of this size, in pixels.

    A camera of another size is scaled where its picture has the same aspect as the images and their pixels are not
    square: it is that of the picture without the squeeze, or of whole frames whose fields were taken apart.

    Args:
        pixel_aspect: width of a pixel of the images over its height.

    Raises:
        InputError: it has another size.
    """
    if (camera.width, camera.height) == (width, height):
        return camera
    shown = camera.width * camera.focal_length_y / camera.focal_length_x / camera.height
    if pixel_aspect == 1.0 or abs(shown * height / (width * pixel_aspect) - 1.0) > _SAME_ASPECT:
        check_camera(camera, width, height)
    scaled = _with_two_focal_lengths(camera)
    scaled.rescale(width, height)
    return scaled


def _with_two_focal_lengths(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The same lens in a model whose pixels need not be square."""
    scaled = pycolmap.Camera(camera.todict())
    if camera.model_name in _TWO_FOCAL_LENGTHS:
        scaled.model, zeros = _TWO_FOCAL_LENGTHS[camera.model_name]
        scaled.params = [camera.params[0], *camera.params, *(0.0,) * zeros]
    return scaled


def camera_from_json(content: Mapping[str, Any]) -> pycolmap.Camera:
    """The camera from the content of a camera file.

    Raises:
        InputError: a key is missing, or a value is out of range.
    """
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
