"""Control from files: known poses, points, distances and heights, and cameras that other programs have tracked."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import pycolmap

from factorsfm.control.known import Control, KnownDistance, KnownHeight, KnownPose, MarkedPoint
from factorsfm.control.tracked import TrackedCamera, is_camera_file, read_tracked
from factorsfm.frames.sequences import sequence_numbers
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json, typed

_KINDS, _CAMERAS = ("poses", "points", "distances", "heights"), "cameras"
# Of a tracked camera, where nothing is said: so loose that the images decide its path, and its world stays.
_PATH_SHARE = 0.01  # of the diagonal of its path: sigma of each coordinate
_ROTATION_DEG = 0.5
_STARTS = (0, 1, 1001)  # of timelines: that of a movie is the last one of these before its camera begins


@dataclass(frozen=True, slots=True)
class _Cameras:
    """What a control file says of a camera that another program has tracked.

    Attributes:
        file: beside the control file, or with its whole path.
        sigma: of each coordinate; None takes a share of the camera's path. rotation_sigma: degrees.
        first_frame: number in the file of the source's first frame, in the names of images, too.
        fps: of an Alembic archive.
    """

    file: str
    sigma: float | None = None
    rotation_sigma: float = _ROTATION_DEG
    first_frame: int | None = None
    fps: float | None = None


def read_control(path: str | Path, first_number: int | None = None) -> Control:
    """Read control from a JSON file: lists "poses", "points", "distances" and "heights" of objects.

    The keys of the objects are the attributes of `KnownPose`, `MarkedPoint`, `KnownDistance` and `KnownHeight`. An
    object "cameras" names the file of a camera that another program has tracked (`read_tracked`): ``file``, and if
    wanted ``sigma``, ``rotation_sigma``, ``first_frame`` and ``fps``. Such a file does instead of the JSON file, too.

    Args:
        first_number: of the first frame of the source, if that is a numbered sequence.

    Raises:
        InputError: not readable, not JSON, an unknown key, or a value that is none.
    """
    path = Path(path)
    try:
        if is_camera_file(path):
            return Control(_tracked(_Cameras(str(path)), first_number), spare=True)
        content = read_json(path, "control file")
        known = (*_KINDS, _CAMERAS)
        if not isinstance(content, dict) or not set(content) <= set(known):
            given = ", ".join(content) if isinstance(content, dict) else type(content).__name__
            raise InputError(f"it holds {given}; an object with {', '.join(known)} is expected")
        parts = _parts(content)
        if _CAMERAS in content:
            cameras = typed(_Cameras, content[_CAMERAS], _CAMERAS)
            parts["poses"] += _tracked(replace(cameras, file=str(path.parent / cameras.file)), first_number)
        return Control(**parts, spare=_CAMERAS in content)
    except InputError as error:
        raise InputError(f"control file {path}: {error}") from error


def _tracked(cameras: _Cameras, first_number: int | None) -> list[KnownPose]:
    """The poses of a tracked camera, by name of their frames, or by index in the source."""
    tracked = read_tracked(Path(cameras.file), cameras.fps)
    share = _PATH_SHARE if cameras.sigma is None else None
    sigma = _PATH_SHARE * tracked.extent if cameras.sigma is None else cameras.sigma
    if not tracked.numbered and cameras.first_frame is not None:
        tracked = _numbered(tracked)
    shift = _shift(tracked, cameras.first_frame, first_number)
    found = []
    for key, pose in tracked.poses.items():
        cam_from_world = pycolmap.Rigid3d(pose[:3]).inverse()
        frame = key if isinstance(key, str) else key - shift
        found.append(replace(KnownPose.at(frame, cam_from_world, sigma, cameras.rotation_sigma), path_share=share))
    return found


def _numbered(tracked: TrackedCamera) -> TrackedCamera:
    """With the numbers in the names of its images for its frames.

    Raises:
        InputError: they differ in more than a number.
    """
    names = sorted(map(str, tracked.poses), key=lambda name: (len(name), name))
    numbers = sequence_numbers(names)
    if numbers is None:
        raise InputError(f"its images, {names[0]} to {names[-1]}, differ in more than a number; first_frame needs that")
    return TrackedCamera({n: tracked.poses[name] for n, name in zip(numbers, names, strict=True)}, numbered=True)


def _shift(tracked: TrackedCamera, first_frame: int | None, first_number: int | None) -> int:
    """Number of a frame in the file, less its index in the source."""
    if not tracked.numbered:
        return 0
    if first_frame is not None:
        return first_frame - (first_number or 0)
    if first_number is not None:  # the files of the source have the numbers of the timeline
        return 0
    first = min(key for key in tracked.poses if isinstance(key, int))
    return max((start for start in _STARTS if start <= first), default=first)


def control_of(content: Any) -> Control:
    """Control from its `asdict` as JSON; errors as in `read_control`."""
    if not isinstance(content, dict):
        raise InputError(f"the control is a {type(content).__name__}; an object is expected")
    return Control(**_parts(content), spare=bool(content.get("spare")))


def _parts(content: dict[str, Any]) -> dict[str, list[Any]]:
    kinds: tuple[type, ...] = (KnownPose, MarkedPoint, KnownDistance, KnownHeight)
    return {name: _items(content.get(name, []), name, kind) for name, kind in zip(_KINDS, kinds, strict=True)}


def _items(values: Any, name: str, kind: type) -> list[Any]:
    if not isinstance(values, list):
        raise InputError(f'"{name}" is a {type(values).__name__}; a list is expected')
    known = [f.name for f in fields(kind)]
    items = []
    for i, value in enumerate(values):
        try:
            if not isinstance(value, dict) or not set(value) <= set(known):
                raise InputError(f"it is {value!r}; an object with {', '.join(known)} is expected")
            items.append(kind(**value))
        except InputError as error:
            raise InputError(f"{name}[{i}]: {error}") from error
        except TypeError as error:  # a key is missing
            missing = str(error).rpartition(": ")[2].replace("'", '"')
            raise InputError(f"{name}[{i}]: {missing} is missing") from error
    return items
