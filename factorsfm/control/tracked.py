"""A camera that another program has tracked, from its files, as known poses.

A file is read as the export of its format writes one: worlds with another axis up are turned, so that exports of the
result are in the world of the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.control.known import STILL
from factorsfm.support.blender import found_in_blender
from factorsfm.support.colmap_model import open_colmap_model
from factorsfm.support.errors import InputError
from factorsfm.support.extras import require
from factorsfm.support.json_reading import read_json, typed
from factorsfm.support.up_axis import FILM_CAMERA, TURNED_WORLD, UpAxis

Array = NDArray[np.float64]
Poses = dict[str | int, Array]  # (4, 4) camera to world in OpenCV's axes, by name or number of the frame

_COLMAP = ("images.bin", "images.txt")
# The active camera of the scene, as its constraints and parents place it.
_CAMERA_IN_BLENDER = """
scene, found = bpy.context.scene, []
for number in range(scene.frame_start, scene.frame_end + 1) if scene.camera else ():
    scene.frame_set(number)
    camera = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found.append((number, [list(row) for row in camera.matrix_world]))
"""
_LARGEST = 1e12  # of a number: its square stays finite


@dataclass(frozen=True, slots=True)
class TrackedCamera:
    """A camera from another program.

    Attributes:
        poses: by name or number of the frame.
        numbered: whether frames have the numbers of the program's timeline, not names.
    """

    poses: Poses
    numbered: bool

    @property
    def extent(self) -> float:
        """Diagonal of the box around its positions."""
        return float(np.linalg.norm(np.ptp([pose[:3, 3] for pose in self.poses.values()], axis=0)))


def is_camera_file(path: Path) -> bool:
    """Whether a path has the name of a file or folder that `read_tracked` reads."""
    return path.is_dir() or path.suffix.lower() in _READERS or path.name == "transforms.json"


def read_tracked(path: Path, fps: float | None = None) -> TrackedCamera:
    """The camera in a file of Nuke (.chan), USD, Alembic or Blender, nerfstudio's transforms.json, or COLMAP's model.

    Args:
        fps: of an Alembic archive, which has times instead of frames; None takes the rate that it states, as exports
            do, else the shortest time between samples for a frame.

    Raises:
        InputError: it cannot be read, or holds no camera, or more than one, or one that stands still.
    """
    if path.is_dir():
        model = next((place for place in (path, path / "sparse" / "0", path / "sparse") if _is_model(place)), None)
        if model is not None:
            tracked = TrackedCamera(_colmap(model), numbered=False)
        elif (path / "transforms.json").is_file():
            tracked = TrackedCamera(_nerfstudio(path / "transforms.json"), numbered=False)
        else:
            raise InputError(f"it has neither {' nor '.join(_COLMAP)} nor transforms.json")
    elif not path.is_file():
        raise InputError(f"there is no file {path}")
    elif path.suffix.lower() == ".json":
        tracked = TrackedCamera(_nerfstudio(path), numbered=False)
    elif path.suffix.lower() not in _READERS:
        raise InputError(f"{path.name} ends in none of {', '.join(_READERS)}, .json")
    else:
        read = _READERS[path.suffix.lower()]
        tracked = TrackedCamera(_alembic(path, fps) if read is None else read(path), numbered=True)
    if not tracked.poses:
        raise InputError("it holds no pose of a camera")
    values = np.array(list(tracked.poses.values()))
    if not (np.abs(values) <= _LARGEST).all():
        raise InputError(f"a pose in it is not finite, or beyond {_LARGEST:g}")
    if tracked.extent <= STILL * max(1.0, np.abs(values[:, :3, 3]).max()):
        raise InputError("its camera stands still, which gives a scene no size; positions that differ are expected")
    return tracked


def _add(poses: Poses, frame: str | int, pose: Array) -> None:
    """Put the pose of another frame to the others: of two, nobody knows which is right."""
    if frame in poses:
        raise InputError(f'frame "{frame}" is there twice')
    poses[frame] = pose


def _opencv(world_from_film: Array, up: UpAxis, scale: float = 1.0) -> Array:
    """(..., 4, 4) in the world and with the camera axes of a reconstruction, from those of another tool.

    Args:
        scale: world units of the reconstruction in one of the tool.
    """
    world = np.eye(4)
    world[:3, :3] = TURNED_WORLD[up].T
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused with the poses
        found = world @ world_from_film @ FILM_CAMERA
        found[..., :3, 3] *= scale
    return np.asarray(found)


def _chan(path: Path) -> Poses:
    """Lines of ``frame tx ty tz rx ry rz``, degrees; rotation about z, then x, then y; further columns are ignored."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(f"it cannot be read: {getattr(error, 'strerror', None) or 'it is no text'}") from error
    found: Poses = {}
    for line in text.splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            number, *place = (float(word) for word in line.split()[:7])
            if len(place) != 6 or number != round(number):
                raise ValueError
        except (ValueError, OverflowError) as error:
            raise InputError(f'the line "{line[:60]}" is not "frame tx ty tz rx ry rz" in numbers') from error
        x, y, z = (cv2.Rodrigues(np.radians(a) * axis)[0] for a, axis in zip(place[3:], np.eye(3), strict=True))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = y @ x @ z, place[:3]
        _add(found, round(number), _opencv(matrix, UpAxis.Y))
    return found


def _is_model(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _COLMAP)


def _colmap(folder: Path) -> Poses:
    found: Poses = {}
    for _, image in sorted(open_colmap_model(folder).images.items()):
        if image.has_pose:
            _add(found, image.name, np.vstack([image.cam_from_world().inverse().matrix(), [0.0, 0.0, 0.0, 1.0]]))
    return found


@dataclass(frozen=True, slots=True)
class _Frame:
    file_path: str
    transform_matrix: list[list[float]]


@dataclass(frozen=True, slots=True)
class _Transforms:
    frames: list[_Frame]


def _nerfstudio(path: Path) -> Poses:
    found: Poses = {}
    for frame in typed(_Transforms, read_json(path, "camera file"), path.name).frames:
        matrix = frame.transform_matrix
        if len(matrix) not in (3, 4) or {len(row) for row in matrix} != {4}:
            raise InputError(f"the transform_matrix of {frame.file_path} is not 4x4")
        parts = PurePath(frame.file_path).parts
        name = "/".join(parts[1:] if len(parts) > 1 and parts[0].startswith("images") else parts)
        _add(found, name, _opencv(np.vstack([matrix[:3], [[0.0, 0.0, 0.0, 1.0]]]), UpAxis.Z))
    return found


def _usd(path: Path) -> Poses:
    usd, geom = require("pxr.Usd"), require("pxr.UsdGeom")
    try:
        stage = usd.Stage.Open(str(path))
    except Exception as error:  # pxr.Tf.ErrorException
        raise InputError("it is no USD stage") from error
    cameras = [prim for prim in stage.Traverse() if prim.IsA(geom.Camera)]
    prim = _one(cameras, [str(prim.GetPath()) for prim in cameras])
    up = UpAxis.Z if geom.GetStageUpAxis(stage) == geom.Tokens.z else UpAxis.Y
    scale = float(geom.GetStageMetersPerUnit(stage))
    times: set[float] = set()
    above = prim
    while above and above.IsA(geom.Xformable):
        times.update(geom.Xformable(above).GetTimeSamples())
        above = above.GetParent()
    found: Poses = {}
    for time in sorted(times):
        if time == round(time):
            matrix = np.array(geom.XformCache(usd.TimeCode(time)).GetLocalToWorldTransform(prim), np.float64).T
            found[round(time)] = _opencv(_without_scale(matrix), up, scale)
    return found


def _alembic(path: Path, fps: float | None) -> Poses:
    abc, geom = require("alembic3d.Abc"), require("alembic3d.AbcGeom")
    try:
        archive = abc.IArchive(str(path))
    except RuntimeError as error:
        raise InputError("it is no Alembic archive") from error
    cameras: list[list[Any]] = []
    _collect(archive.getTop(), [], cameras, geom)
    chain = _one(cameras, [header.getName() for *_, header in cameras])[:-1]
    transforms = [geom.IXform(parent, header.getName()).getSchema() for parent, header in chain]
    longest = max(transforms, key=lambda schema: schema.getNumSamples(), default=None)
    if longest is None:
        return {}
    sampling = longest.getTimeSampling()
    times = [sampling.getSampleTime(k) for k in range(longest.getNumSamples())]
    rate = fps or abc.GetArchiveInfo(archive).get("dccFPS") or _frame_rate(times)
    nearest: dict[int, float] = {}  # of several samples in a frame, which show how it moves while the shutter is open
    for time in sorted(times, key=lambda time: abs((time * rate + 0.5) % 1.0 - 0.5)):
        nearest.setdefault(math.floor(time * rate + 0.5), time)
    found: Poses = {}
    for number, time in sorted(nearest.items()):
        matrix = np.eye(4)
        for schema in transforms:
            sample = schema.getValue(abc.ISampleSelector(time))
            matrix = matrix @ np.array([[sample.getMatrix()[row][k] for row in range(4)] for k in range(4)])
        found[number] = _opencv(_without_scale(matrix), UpAxis.Y)
    return found


def _collect(thing: Any, chain: list[Any], cameras: list[list[Any]], geom: Any) -> None:
    """Appends the transforms down to each camera below a thing, and last the camera's header."""
    for k in range(thing.getNumChildren()):
        header = thing.getChildHeader(k)
        if geom.ICamera.matches(header.getMetaData()):
            cameras.append([*chain, header])
        elif geom.IXform.matches(header.getMetaData()):
            _collect(thing.getChild(k), [*chain, (thing, header)], cameras, geom)


def _blender(path: Path) -> Poses:
    found = found_in_blender(path, _CAMERA_IN_BLENDER)
    if not found:
        raise InputError("its scene has no camera")
    return {number: _opencv(_without_scale(np.array(matrix)), UpAxis.Z) for number, matrix in found}


def _frame_rate(times: list[float]) -> float:
    """Frames a second: the samples next to each other are one frame apart."""
    steps = np.diff(times)
    return 1.0 / float(steps[steps > 0].min()) if (steps > 0).any() else 1.0


def _without_scale(matrix: Array) -> Array:
    """A rigid transform: what scales a camera does not change what it sees."""
    rigid = matrix.copy()
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    rigid[:3, :3] = u @ vt
    return rigid


def _one(found: list[Any], names: list[str]) -> Any:
    if len(found) != 1:
        raise InputError(f"it holds {len(found)} cameras ({', '.join(names[:3]) or 'none'}); one is expected")
    return found[0]


_READERS: dict[str, Callable[[Path], Poses] | None] = {
    ".chan": _chan, ".usd": _usd, ".usda": _usd, ".usdc": _usd, ".abc": None, ".blend": _blender,
}  # fmt: skip
