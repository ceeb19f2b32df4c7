"""Gravity as photographs state it: the accelerometer of a phone, the gimbal of a drone."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.photographs import lies_otherwise

Array = NDArray[np.float64]

_EXIF, _ORIENTATION, _MAKER_NOTE, _LENS = 0x8769, 0x0112, 0x927C, 0xA434  # tags
_APPLE, _ACCELERATION = b"Apple iOS\0", 0x0008  # how its maker note begins, and the tag in it
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}  # of a value, by its type
_STILL_G = (0.8, 1.2)  # of a phone that is held in the hand
# Right and down in the image as it is shown, from those of the sensor, by the orientation; the others are mirrored.
_SHOWN = {1: ((1, 0), (0, 1)), 3: ((-1, 0), (0, -1)), 6: ((0, -1), (1, 0)), 8: ((0, 1), (-1, 0))}
_LEAST_PHOTOS = 2
_MOST_APART, _BIAS = 5.0, 1.0  # degrees: between photographs, half of them; of the sensor or gimbal in all of them
_GIMBAL_DEGREES = rb"Gimbal%sDegree\s*(?:=\s*[\"']|>)\s*([+-]?\d+\.?\d*)"


def up_from_photos(views: Iterable[tuple[Path, pycolmap.Camera, pycolmap.Rigid3d]]) -> tuple[Array, float] | None:
    """Up in the world, and its standard deviation in degrees; None where too few photographs say it, or disagree.

    Args:
        views: files, with their cameras and `cam_from_world`.
    """
    said = [(down, pose) for path, camera, pose in views if (down := down_in_photo(path, camera)) is not None]
    if len(said) < _LEAST_PHOTOS:
        return None
    ups = np.array([-(pose.rotation.matrix().T @ down) for down, pose in said])
    mean = np.median(ups, axis=0)
    mean /= np.linalg.norm(mean)
    apart = np.degrees(np.arccos(np.clip(ups @ mean, -1.0, 1.0)))
    if np.median(apart) > _MOST_APART:
        return None
    return mean, float(np.hypot(_BIAS, np.median(apart) / np.sqrt(len(said))))


def down_in_photo(path: Path, camera: pycolmap.Camera) -> Array | None:
    """(3,) unit vector to the ground in the camera of a photograph: x right, y down, z ahead, as it is shown.

    None where the file does not say it. Phones of Apple write it into their maker note, drones of DJI into XMP.

    Args:
        camera: with which it was solved, turned left if its format is the other one (`frames.photographs`).
    """
    small, kinds, blocks = cv2.imreadWithMetadata(str(path), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    if small is None:
        return None
    data = {kind: np.asarray(block).tobytes() for kind, block in zip(kinds, blocks, strict=True)}
    try:
        orientation, down = _stated_by_phone(data[cv2.IMAGE_METADATA_EXIF])
        shown = np.array(_SHOWN[orientation], float)
    except (KeyError, ValueError, struct.error):  # none, mirrored, or damaged
        shown, down = np.eye(2), None
    if down is None and (shown == np.eye(2)).all():
        down = _stated_by_drone(data.get(cv2.IMAGE_METADATA_XMP, b""))
    if down is None:
        return None
    turned = np.array(_SHOWN[8], float) if lies_otherwise(small.shape[1::-1], camera) else np.eye(2)
    return np.append(turned @ shown @ down[:2], down[2])


def _stated_by_phone(exif: bytes) -> tuple[int, Array | None]:
    """The orientation in EXIF data, and (3,) to the ground in the camera of the sensor; None where they do not say it.

    The acceleration is along the phone's right, its top, and out of its screen. The camera at the back looks the other
    way, and the right of its sensor is the phone's bottom.
    """
    order = _byte_order(exif[:2])
    main = _tags(exif, struct.unpack_from(order + "I", exif, 4)[0], order)
    orientation = struct.unpack(order + "H", main[_ORIENTATION])[0] if _ORIENTATION in main else 1
    more = _tags(exif, struct.unpack(order + "I", main[_EXIF])[0], order) if _EXIF in main else {}
    note = more.get(_MAKER_NOTE, b"")
    if not note.startswith(_APPLE) or b"front" in more.get(_LENS, b""):
        return orientation, None
    begin = len(_APPLE) + 2  # of its byte order, after a version
    order = _byte_order(note[begin : begin + 2])
    ratios = np.array(struct.unpack(order + "6i", _tags(note, begin + 2, order)[_ACCELERATION]), float).reshape(3, 2)
    right, top, out = ratios[:, 0] / np.where(ratios[:, 1] == 0.0, np.inf, ratios[:, 1])
    down = np.array([-top, -right, -out])
    size = float(np.linalg.norm(down))
    return orientation, down / size if _STILL_G[0] < size < _STILL_G[1] else None


def _stated_by_drone(xmp: bytes) -> Array | None:
    """(3,) to the ground under the pitch and roll of a gimbal: turned from level about its right, then about ahead."""
    found = [re.search(_GIMBAL_DEGREES % name, xmp) for name in (b"Pitch", b"Roll")]
    if found[0] is None or found[1] is None:
        return None
    pitch, roll = (np.radians(float(match[1])) for match in found if match is not None)
    return np.array([np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), -np.sin(pitch)])


def _byte_order(mark: bytes) -> str:
    """Of `struct`, by the mark at the beginning of a directory.

    Raises:
        ValueError: it is no such mark.
    """
    orders = {b"II": "<", b"MM": ">"}
    if mark not in orders:
        raise ValueError(f"the byte order is {mark!r}, II or MM expected")
    return orders[mark]


def _tags(data: bytes, offset: int, order: str) -> dict[int, bytes]:
    """The bytes of the values of a directory of tags in EXIF data; struct.error where it is damaged."""
    tags = {}
    for row in range(struct.unpack_from(order + "H", data, offset)[0]):
        tag, kind, count, begin = struct.unpack_from(order + "HHII", data, place := offset + 2 + 12 * row)
        size = count * _BYTES.get(kind, 0)
        begin = begin if size > 4 else place + 8
        tags[tag] = data[begin : begin + size]
    return tags
