"""Lens files of other programs: OpenCV's (and ROS's) YAML, COLMAP's cameras.txt, OpenTrackIO; as camera files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.openlensio import content_of_sample, model_of
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import parse_json

Array = NDArray[np.float64]

_MATRIX = ("camera_matrix", "cameraMatrix", "K", "k")  # ROS 1 and 2 have K and k in their messages
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "D", "d")
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_FISHEYE = ("fisheye", "equidistant")  # what ROS calls the model
_SAMPLE = {"static", "lens"}  # keys of OpenTrackIO
_YAML, _XML = (".yml", ".yaml"), ".xml"


def content_of(path: Path) -> Any:
    """The content of a camera file (`camera_from_json`), from a file of any kind that is known.

    Raises:
        InputError: the file cannot be read, or does not say all of one lens.
    """
    suffix = path.suffix.lower()
    if suffix == ".txt":
        return _colmap(path)
    if suffix in (*_YAML, _XML):
        return _opencv(path)
    content = _first_json(path)
    if not isinstance(content, dict):
        return content
    return content_of_sample(content) if content.keys() >= _SAMPLE else content


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(f"it cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _first_json(path: Path) -> Any:
    """The JSON value of a file, or that of the first of its lines, each of which is a sample."""
    text = _text(path)
    try:
        return parse_json(text)
    except (ValueError, RecursionError) as error:
        try:
            first = parse_json(text.partition("\n")[0])
        except (ValueError, RecursionError):
            first = None
        if isinstance(first, dict) and first.keys() >= _SAMPLE:
            return first
        raise InputError(f"it is not JSON: {error}") from error


def _colmap(path: Path) -> dict[str, Any]:
    lines = [line.split() for line in _text(path).splitlines()]
    cameras = [words for words in lines if words and not words[0].startswith("#")]
    if len(cameras) != 1:
        raise InputError(f"it holds {len(cameras)} cameras; one is expected")
    _, model, *values = cameras[0] if len(cameras[0]) > 3 else ("", "", "")
    try:
        width, height, *params = map(float, values)
    except ValueError as error:
        raise InputError(
            f'its line is "{" ".join(cameras[0])}"; CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] is expected'
        ) from error
    if model not in set(pycolmap.CameraModelId.__members__) - {"INVALID"}:
        raise InputError(f'"model" is {model!r}; the name of a COLMAP camera model is expected')
    centers = pycolmap.Camera(model=model, width=1, height=1).principal_point_idxs()
    for index in [index for index in centers if index < len(params)]:
        params[index] -= PIXEL_CENTER
    return {"width": width, "height": height, "model": model, "params": params}


def _opencv(path: Path) -> dict[str, Any]:
    text = _text(path)
    if path.suffix.lower() in _YAML and not text.startswith("%YAML"):
        text = f"%YAML:1.0\n---\n{_first_document(text)}"
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise InputError("it is not YAML or XML as OpenCV reads it") from error
    matrix = next(_arrays(storage, _MATRIX), None)
    if matrix is None or matrix.size != 9:
        raise InputError(f"it has no 3x3 matrix under {', '.join(_MATRIX)}")
    (fx, skew, cx), (zero, fy, cy), _ = matrix.reshape(3, 3).tolist()
    if skew or zero:
        raise InputError(f"the skew in the camera matrix is {skew or zero:g}; 0 is expected")
    model = storage.getNode("distortion_model")
    fisheye = model.isString() and model.string() in _FISHEYE
    extra = next(_arrays(storage, _COEFFICIENTS), np.zeros(0)).ravel().tolist()
    size = {name: _number(storage, names) for name, names in (("width", _WIDTH), ("height", _HEIGHT))}
    named, extra = ("OPENCV_FISHEYE", extra) if fisheye else _perspective(extra)
    return {**size, "model": named, "params": [fx, fy, cx, cy, *extra]}


def _first_document(text: str) -> str:
    """The first document of a YAML file, of which OpenCV reads one alone; lists are indented, as it expects them."""
    parts = re.split(r"^---[ \t]*$", text, flags=re.MULTILINE)
    first = next((part for part in parts if re.search(r"^[^#\s]", part, re.MULTILINE)), "")
    return re.sub(r"^( *)- ", r"\1  - ", first, flags=re.MULTILINE)


def _perspective(extra: list[float]) -> tuple[str, list[float]]:
    """COLMAP's model and parameters of OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, and further ones."""
    if len(extra) not in (0, 4, 5, 8, 12, 14) or any(extra[8:]):
        raise InputError(f"it has {len(extra)} distortion coefficients; 0, 4, 5 or 8 are expected, and no thin prism")
    extra = extra[:8] if any(extra[4:]) else extra[:4]
    extra += [0.0] * (8 - len(extra) if len(extra) > 4 else 0)
    return model_of(extra), extra


def _arrays(storage: cv2.FileStorage, names: tuple[str, ...]) -> Iterator[Array]:
    """The arrays under some names: OpenCV's matrices and those of ROS's files, or the plain lists of its messages."""
    for name in names:
        node = storage.getNode(name)
        values = node.getNode("data") if node.isMap() else node
        if values.isSeq():  # not node.mat(), which asserts that the sizes are right
            items = [values.at(k) for k in range(values.size())]
            if not all(item.isInt() or item.isReal() for item in items):
                raise InputError(f"{name} holds something else than numbers; a plain list of them is expected")
            yield np.array([item.real() for item in items])


def _number(storage: cv2.FileStorage, names: tuple[str, ...]) -> float:
    for name in names:
        node = storage.getNode(name)
        if node.isInt() or node.isReal():
            return float(node.real())
    raise InputError(f"it has no {names[0]}")
