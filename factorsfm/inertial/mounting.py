"""How an IMU sits on a camera, as a JSON file beside its recording."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.inertial.reading import read_imu
from factorsfm.inertial.recording import ImuNoise, ImuRecording
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json

Array = NDArray[np.float64]

_KEYS = ("file", "cam_from_imu", "lever_arm", "time_offset", "noise")


def open_imu(path: str | Path) -> ImuRecording:
    """A recording (`read_imu`), or a JSON file that names one and says how the IMU sits on the camera.

    The JSON file is an object with ``file``, the recording's path relative to it, and any of ``cam_from_imu`` (unit
    quaternion x, y, z, w of the rotation from the IMU's axes to the camera's), ``lever_arm`` (position of the IMU in
    the camera's axes, metres), ``time_offset`` (seconds to add to the IMU's time) and ``noise`` (values of `ImuNoise`).
    What is missing is estimated, the lever arm and the noise excepted.

    Raises:
        InputError: a file cannot be read, or holds something else.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return read_imu(path)
    content = read_json(path, "IMU file")
    if not isinstance(content, dict) or not isinstance(content.get("file"), str) or not set(content) <= set(_KEYS):
        raise InputError(f'IMU file {path}: an object with "file" and any of {", ".join(_KEYS[1:])} is expected')
    recording = read_imu(path.parent / content["file"])
    try:
        return replace(
            recording,
            cam_from_imu=_rotation(content.get("cam_from_imu")),
            lever_arm=_numbers("lever_arm", content.get("lever_arm", [0, 0, 0]), 3),
            time_offset=_number("time_offset", content["time_offset"]) if "time_offset" in content else None,
            noise=_noise(content.get("noise", {})),
        )
    except InputError as error:
        raise InputError(f"IMU file {path}: {error}") from error


def _numbers(name: str, value: Any, count: int) -> Array:
    if not isinstance(value, list) or len(value) != count or not all(map(_is_number, value)):
        raise InputError(f'"{name}" is {value!r}; {count} numbers are expected')
    return np.array(value, np.float64)


def _rotation(value: Any) -> Array | None:
    if value is None:
        return None
    quaternion = _numbers("cam_from_imu", value, 4)
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
        raise InputError(f'"cam_from_imu" is {value}; a unit quaternion is expected')
    return np.asarray(pycolmap.Rotation3d(quaternion).matrix())


def _noise(value: Any) -> ImuNoise:
    known = asdict(ImuNoise())
    if not isinstance(value, dict) or not set(value) <= set(known):
        raise InputError(f'"noise" is {value!r}; an object with any of {", ".join(known)} is expected')
    return ImuNoise(**{name: _number(name, number) for name, number in value.items()})


def _number(name: str, value: Any) -> float:
    if not _is_number(value):
        raise InputError(f'"{name}" is {value!r}; a number is expected')
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
