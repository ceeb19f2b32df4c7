"""A running stream as one file: plain values and arrays, written whole or not at all, and read without running code."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import camera_from_json, camera_to_json
from factorsfm.graph.added_factors import AddedFactors
from factorsfm.inertial.timing import ImuTiming
from factorsfm.mapping.map_copy import MapUpdate
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.streaming.relocalization import KeyframeView
from factorsfm.support.errors import InputError
from factorsfm.support.output_files import replaced_file
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

_MAGIC, _ANY_MAGIC = b"factorsfm-3\n", b"factorsfm-"
_CHECKSUM_BYTES = 32
_DTYPES = {"bool", "uint8", "int32", "int64", "uint64", "float32", "float64"}
_TYPES: dict[str, Any] = {
    t.__name__: t
    for t in (AddedFactors, FrameStatus, ImageDepth, ImageTracks, ImuTiming, KeyframeView, MappedImage, MapUpdate)
}


def write_snapshot(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state: nested dicts, lists, tuples, numbers, strings, arrays, cameras, and the estimator's own records.

    Raises:
        InputError: the file cannot be written, or is something else than a snapshot; what is at its place is untouched.
    """
    _check_replaceable(path)
    writer = _Writer()
    header = json.dumps(writer.packed(state)).encode()
    body = b"".join([_MAGIC, len(header).to_bytes(8, "little"), header, *writer.chunks])
    temporary = None
    try:
        target = replaced_file(path)
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=f".{path.name}.", delete=False) as file:
            temporary = Path(file.name)
            file.write(body)
            file.write(hashlib.sha256(body).digest())
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise InputError(f"snapshot {path} cannot be written: {error.strerror}") from error


def _check_replaceable(path: Path) -> None:
    """Refuse to replace a file that is no snapshot, such as the footage."""
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            begin = file.read(len(_ANY_MAGIC))
    except OSError as error:
        raise InputError(f"snapshot {path} cannot be written: {error.strerror}") from error
    if begin and begin != _ANY_MAGIC:
        raise InputError(f"snapshot {path} would overwrite a file that is no snapshot; choose another path")


def read_snapshot(path: Path) -> dict[str, Any]:
    """The state that `write_snapshot` wrote.

    Raises:
        InputError: the file cannot be read, is no snapshot, is torn, or holds anything but a state.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"snapshot {path} cannot be read: {error.strerror}") from error
    if not data.startswith(_ANY_MAGIC):
        raise InputError(f"{path} is not a snapshot of a stream")
    if not data.startswith(_MAGIC):
        raise InputError(f"snapshot {path} is of another version of factorsfm; read it with that one, or begin anew")
    body, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if hashlib.sha256(body).digest() != checksum:
        raise InputError(f"snapshot {path} is torn: its checksum is wrong")
    begin = len(_MAGIC) + 8
    end = begin + int.from_bytes(body[len(_MAGIC) : begin], "little")
    try:
        state = _Reader(body[end:]).value(json.loads(body[begin:end]))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, InputError) as error:
        raise InputError(f"snapshot {path} does not hold the state of a stream: {error!r}") from error
    if not isinstance(state, dict):
        raise InputError(f"snapshot {path} does not hold the state of a stream")
    return state


class _Writer:
    """Turns values into JSON; the bytes of arrays go into `chunks`, and a shared camera is written once."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self._cameras: dict[int, int] = {}  # by the identity of the object

    def packed(self, value: Any) -> Any:
        if isinstance(value, Enum):
            return {"type": type(value).__name__, "value": value.value}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            stored = _compact(value)
            self.chunks.append(np.ascontiguousarray(stored).tobytes())
            return {"array": stored.dtype.name, "shape": value.shape, "as": value.dtype.name}
        if isinstance(value, list | tuple):
            return {type(value).__name__: [self.packed(item) for item in value]}
        if isinstance(value, Mapping):
            return {"dict": [[self.packed(k), self.packed(v)] for k, v in value.items()]}
        if isinstance(value, pycolmap.Camera):
            return self._camera(value)
        if is_dataclass(value) and type(value).__name__ in _TYPES:
            record = {f.name: self.packed(getattr(value, f.name)) for f in fields(value)}
            return {"type": type(value).__name__, "fields": record}
        raise TypeError(f"a {type(value).__name__} cannot be part of a snapshot")

    def _camera(self, camera: pycolmap.Camera) -> dict[str, Any]:
        if id(camera) in self._cameras:
            return {"same_camera": self._cameras[id(camera)]}
        self._cameras[id(camera)] = len(self._cameras)
        return {"camera": camera_to_json(camera), "focal_told": camera.has_prior_focal_length}


class _Reader:
    """Takes the arrays from the bytes in the order in which they were written."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0
        self._cameras: list[pycolmap.Camera] = []

    def value(self, packed: Any) -> Any:
        if not isinstance(packed, dict):
            return packed
        if "array" in packed:
            return self._array(packed["array"], packed["shape"]).astype(_dtype(packed["as"]))
        if "list" in packed:
            return [self.value(item) for item in packed["list"]]
        if "tuple" in packed:
            return tuple(self.value(item) for item in packed["tuple"])
        if "dict" in packed:
            return {self.value(key): self.value(item) for key, item in packed["dict"]}
        if "camera" in packed:
            self._cameras.append(camera_from_json(packed["camera"]))
            self._cameras[-1].has_prior_focal_length = packed["focal_told"]
            return self._cameras[-1]
        if "same_camera" in packed:
            return self._cameras[packed["same_camera"]]
        if "fields" in packed:
            return _TYPES[packed["type"]](**{name: self.value(item) for name, item in packed["fields"].items()})
        return _TYPES[packed["type"]](packed["value"])

    def _array(self, dtype: str, shape: list[int]) -> NDArray[Any]:
        if any(length < 0 for length in shape):
            raise ValueError(f"an array of shape {shape}")
        size = math.prod(shape) * _dtype(dtype).itemsize
        begin, self._position = self._position, self._position + size
        return np.frombuffer(self._data[begin : self._position], dtype).reshape(shape)


def _dtype(name: str) -> np.dtype[Any]:
    if name not in _DTYPES:
        raise ValueError(f"arrays of {name} are not expected")
    return np.dtype(name)


def _compact(array: NDArray[Any]) -> NDArray[Any]:
    """The same values in half of the bytes, where these hold them exactly: tracks are measured in single precision."""
    half = {"float64": np.float32, "int64": np.int32}.get(array.dtype.name)
    if half is None:
        return array
    with np.errstate(over="ignore", invalid="ignore"):
        stored = array.astype(half)
    return stored if np.array_equal(stored, array, equal_nan=array.dtype.kind == "f") else array
