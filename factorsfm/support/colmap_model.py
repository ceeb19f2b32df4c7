"""COLMAP's models of other programs, opened only where their binary files are whole.

pycolmap takes what lies behind the end of a file for numbers: it loops without an end, or reads another camera.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pycolmap

from factorsfm.support.errors import InputError


def open_colmap_model(folder: Path) -> pycolmap.Reconstruction:
    """A model, text or binary.

    Raises:
        InputError: it cannot be read, or a binary file ends before its counts say.
    """
    for name, end_of in _ENDS.items():
        path = folder / f"{name}.bin"
        if path.is_file() and not _is_whole(path, end_of):
            raise InputError(f"{name}.bin of the COLMAP model in {folder} is not whole")
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"the COLMAP model in {folder} cannot be read") from error


def _is_whole(path: Path, end_of: Callable[[bytes, int], int]) -> bool:
    try:
        data = path.read_bytes()
        (count,) = struct.unpack_from("<Q", data)
        end = 8
        for _ in range(count):  # each has a size, so that a wrong count ends with the file
            end = end_of(data, end)
            if end > len(data):
                return False
    except (OSError, struct.error, ValueError):
        return False
    return True


def _end_of_camera(data: bytes, start: int) -> int:
    """Id, model, width, height and parameters."""
    (model,) = struct.unpack_from("<i", data, start + 4)
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return start + 24 + 8 * len(camera.params)


def _end_of_image(data: bytes, start: int) -> int:
    """Id, pose, camera, name, and x, y and point of each observation."""
    count = data.index(b"\0", start + 64) + 1
    return count + 8 + 24 * int(struct.unpack_from("<Q", data, count)[0])


def _end_of_point(data: bytes, start: int) -> int:
    """Id, place, colour, error, and image and number of each observation."""
    return start + 51 + 8 * int(struct.unpack_from("<Q", data, start + 43)[0])


def _end_of_rig(data: bytes, start: int) -> int:
    """Id, reference, and each further sensor with its pose where it has one."""
    sensors = int(struct.unpack_from("<I", data, start + 4)[0])
    end = start + 8 + 8 * min(sensors, 1)
    for _ in range(sensors - 1):
        end += 9 + 56 * int(struct.unpack_from("<B", data, end + 8)[0])
    return end


def _end_of_frame(data: bytes, start: int) -> int:
    """Id, rig, pose, and sensor and image of each datum."""
    return start + 68 + 16 * int(struct.unpack_from("<I", data, start + 64)[0])


_ENDS = {
    "cameras": _end_of_camera, "images": _end_of_image, "points3D": _end_of_point, "rigs": _end_of_rig,
    "frames": _end_of_frame,
}  # fmt: skip
