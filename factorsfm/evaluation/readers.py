"""Readers of data sets: shots with ground truth, from the formats in which they are distributed."""

from __future__ import annotations

import copy
import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import read_camera
from factorsfm.evaluation.plain_pickle import load_plain_pickle
from factorsfm.evaluation.truth import DepthLookup, DepthMaps, RawDepthMaps, Shot, no_depth
from factorsfm.frames.folders import list_files, list_images, read_image
from factorsfm.frames.reading import read_frames
from factorsfm.frames.video import VIDEO_SUFFIXES
from factorsfm.support.colmap_model import open_colmap_model
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json
from factorsfm.support.rotations import nearest_rotation
from factorsfm.support.similarity import pose_arrays

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_TUM_TOLERANCE_SECONDS = 0.02  # between an image and its pose or depth map
_TUM_DEPTH_UNIT = 1.0 / 5000.0  # metres per grey level
_KINECT = (640, 480, 525.0, 525.0, 320.0, 240.0)  # nominal colour camera: width, height, fx, fy, cx, cy


def read_shot(folder: str | Path, unit: float = 1.0) -> Shot:
    """A set of this project: `shot.mp4` or `images/`, `camera.json`, `groundtruth.txt`, `depth/`, `masks/`.

    `groundtruth.txt` holds ``frame tx ty tz qx qy qz qw`` (world_from_cam). `depth/` holds 16-bit maps whose names are
    the frame indices; `camera.json` has their unit as `depth_unit_m` or `depth_unit_mm`.

    Args:
        folder: the set.
        unit: metres per unit of the true translations.

    Raises:
        InputError: a file is missing or unreadable.
    """
    folder = Path(folder)
    camera = read_camera(folder / "camera.json")
    facts = read_json(folder / "camera.json", "camera file")
    table = _read_table(folder / "groundtruth.txt", columns=8)
    depth: DepthLookup = no_depth
    if (folder / "depth").is_dir():
        step = facts.get("depth_unit_m", facts.get("depth_unit_mm", 1.0) / 1000.0)
        depth = DepthMaps({int(p.stem): p for p in _images(folder / "depth")}, float(step))
    video, masks = folder / "shot.mp4", folder / "masks"
    rotations, centers = _from_quaternions(table[:, 1:])
    return _shot(
        folder.name,
        video if video.is_file() else folder / "images",
        camera,
        table[:, 0].astype(np.int64),
        rotations,
        unit * centers,
        depth,
        masks=masks if masks.is_dir() else None,
        files=None if video.is_file() else _images(folder / "images"),
    )


def read_studiosfm(folder: str | Path) -> Shot:
    """A StudioSfM shot as its authors distribute it: images or a video, and `camera.pkl`.

    The pickle maps image ids to ``{'intr_mtx': 3x3, 'v2c': 4x4 cam_from_world}``; it is read without executing code in
    it. An id is the name of an image file, its stem, or the last number in it; in a video, ids count frames from the
    smallest one. The intrinsics are in COLMAP's pixel convention.

    Raises:
        InputError: a file is missing, the pickle holds something else, or an id matches no image.
    """
    folder = Path(folder)
    records = load_plain_pickle(folder / "camera.pkl")
    if not isinstance(records, dict) or not records:
        raise InputError(f"{folder / 'camera.pkl'} holds no dictionary of cameras")
    source, files = _find_frames(folder)
    if files is None:
        start = min(_number(str(key)) for key in records)
        positions = {key: _number(str(key)) - start for key in records}
    else:
        positions = _match_ids(list(records), files)
    matrices, poses = {}, {}
    for key, index in positions.items():
        try:
            matrices[index] = np.asarray(records[key]["intr_mtx"], np.float64).reshape(3, 3)
            poses[index] = np.asarray(records[key]["v2c"], np.float64).reshape(4, 4)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"camera {key!r} of {folder} has no 3x3 'intr_mtx' and 4x4 'v2c'") from error
    indices = np.array(sorted(poses))
    intrinsics = np.array([matrices[i] for i in indices])
    if np.ptp(intrinsics, axis=0).max() > 1e-3 * intrinsics.max():
        logger.warning("the focal length of %s changes; all frames get the lens of the first one", folder)
    k = intrinsics[0]
    width, height = _image_size(source, files)
    camera = _pinhole(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    world_from_cam = _invert(np.array([poses[i] for i in indices]), folder)
    return _shot(folder.name, source, camera, indices, *world_from_cam, files=files)


def read_eth3d(folder: str | Path) -> Shot:
    """An ETH3D scene: a COLMAP text model `dslr_calibration_undistorted` (or `_jpg`) beside `images/`.

    The true depth (`ground_truth_depth/`, raw float32) belongs to the distorted images; maps are used if they have the
    size of the images.

    Raises:
        InputError: the model or its images are missing.
    """
    folder = Path(folder)
    models = [folder / "dslr_calibration_undistorted", folder / "dslr_calibration_jpg"]
    model = next((m for m in models if m.is_dir()), None)
    if model is None:
        raise InputError(f"{folder} holds neither {models[0].name} nor {models[1].name}")
    shot = read_colmap(model, folder / "images", folder.name)
    maps = folder / "ground_truth_depth" / "dslr_images"
    size = 4 * shot.camera.width * shot.camera.height
    found = {i: maps / f.name for i, f in enumerate(shot.files or ()) if (maps / f.name).is_file()}
    fitting = {i: path for i, path in found.items() if path.stat().st_size == size}
    if len(fitting) < len(found):
        logger.warning("%s: %d depth maps have another size than the images", folder, len(found) - len(fitting))
    if not fitting:
        return shot
    return replace(shot, depth=RawDepthMaps(fitting, (shot.camera.height, shot.camera.width)))


def read_tum(folder: str | Path, camera: pycolmap.Camera) -> Shot:
    """A TUM RGB-D sequence: `rgb.txt`, `groundtruth.txt` and perhaps `depth.txt`, matched by time within 20 ms.

    Args:
        folder: the sequence.
        camera: the lens, which the sequence does not hold.

    Raises:
        InputError: a list is missing or unreadable, or no image has a pose.
    """
    folder = Path(folder)
    times, files = _read_tum_list(folder, "rgb.txt")
    table = _read_table(folder / "groundtruth.txt", columns=8)
    rows, posed = _nearest_in_time(table[:, 0], times)
    rotations, centers = _from_quaternions(table[rows[posed], 1:])
    depth: DepthLookup = no_depth
    if (folder / "depth.txt").is_file():
        depth_times, maps = _read_tum_list(folder, "depth.txt")
        nearest, known = _nearest_in_time(depth_times, times)
        depth = DepthMaps({int(i): maps[nearest[i]] for i in np.flatnonzero(known)}, _TUM_DEPTH_UNIT)
    indices = np.flatnonzero(posed)
    return _shot(folder.name, folder / "rgb", camera, indices, rotations, centers, depth, files=files)


def read_7scenes(folder: str | Path, camera: pycolmap.Camera | None = None) -> Shot:
    """A 7-Scenes sequence: `frame-XXXXXX.color.png`, `.depth.png` (mm) and `.pose.txt` (world_from_cam).

    Poses and depth belong to the depth camera of the Kinect, which the data set does not register to the colour camera.

    Args:
        folder: the sequence.
        camera: the lens; None takes the nominal colour camera.

    Raises:
        InputError: there are no images or no poses.
    """
    folder = Path(folder)
    files = tuple(sorted(folder.glob("frame-*.color.png")))
    poses, maps = {}, {}
    for index, path in enumerate(files):
        stem = path.name.removesuffix(".color.png")
        pose, depth = folder / f"{stem}.pose.txt", folder / f"{stem}.depth.png"
        if pose.is_file():
            poses[index] = _read_table(pose, columns=4)
        if depth.is_file():
            maps[index] = depth
    indices = np.array([i for i, pose in poses.items() if pose.shape == (4, 4) and np.isfinite(pose).all()])
    matrices = np.array([poses[i] for i in indices]).reshape(-1, 4, 4)
    return _shot(
        folder.name,
        folder,
        camera or _pinhole(*_KINECT),
        indices,
        _rotations(matrices[:, :3, :3], folder),
        matrices[:, :3, 3],
        DepthMaps(maps, 0.001, invalid=65535) if maps else no_depth,
        files=files,
    )


def read_colmap(model: str | Path, images: str | Path, name: str | None = None) -> Shot:
    """A COLMAP model, text or binary, as truth. The frames are all images in the folder of the model's images.

    If the model has several cameras, only images of the most frequent one have a true pose.

    Args:
        model: folder of the model.
        images: folder to which the names of the images are relative.
        name: name of the shot; None takes that of the model.

    Raises:
        InputError: the model cannot be read, or its images are missing or in several folders.
    """
    model, images = Path(model), Path(images)
    reconstruction = open_colmap_model(model)
    posed = [image for image in reconstruction.images.values() if image.has_pose]
    if not posed:
        raise InputError(f"the COLMAP model {model} has no registered image")
    camera_id, count = Counter(image.camera_id for image in posed).most_common(1)[0]
    if count < len(posed):
        logger.warning("%s: %d images of other cameras are left out", model, len(posed) - count)
        posed = [image for image in posed if image.camera_id == camera_id]
    folders = {(images / image.name).parent for image in posed}
    if len(folders) > 1:
        raise InputError(f"the images of {model} are in {len(folders)} folders, expected one")
    source = folders.pop()
    files = _images(source)
    position = {path.name: i for i, path in enumerate(files)}
    missing = [image.name for image in posed if Path(image.name).name not in position]
    if missing:
        raise InputError(f"the image {missing[0]} of {model} is missing in {images}")
    posed.sort(key=lambda image: position[Path(image.name).name])
    indices = np.array([position[Path(image.name).name] for image in posed])
    rotations, centers = pose_arrays([image.cam_from_world() for image in posed])
    camera = copy.copy(reconstruction.cameras[camera_id])
    return _shot(name or model.name, source, camera, indices, rotations, centers, files=files)


def _shot(
    name: str,
    source: Path,
    camera: pycolmap.Camera,
    indices: NDArray[np.int64],
    rotations: Array,
    centers: Array,
    depth: DepthLookup = no_depth,
    masks: Path | None = None,
    files: tuple[Path, ...] | None = None,
) -> Shot:
    """The shot, with its true poses sorted by frame; an error if it has no frames or no poses."""
    if files is not None and not files:
        raise InputError(f"{source} holds no images")
    if not len(indices):
        raise InputError(f"no frame of {name} has a true pose")
    order = np.argsort(indices)
    return Shot(name, source, camera, indices[order], rotations[order], centers[order], depth, masks, files)


def _find_frames(folder: Path) -> tuple[Path, tuple[Path, ...] | None]:
    """The folder and its images, or those of its first subfolder that has any; otherwise its video, and None."""
    for candidate in (folder, *sorted(p for p in folder.iterdir() if p.is_dir())):
        files = _images(candidate)
        if files:
            return candidate, files
    videos = list_files(folder, VIDEO_SUFFIXES)
    if len(videos) != 1:
        raise InputError(f"{folder} holds no images and {len(videos)} videos, expected one")
    return videos[0], None


def _match_ids(ids: Sequence[object], files: Sequence[Path]) -> dict[object, int]:
    """The position in `files` of each id, which is the name of the file, its stem, or the last number in it."""
    numbers = [re.findall(r"\d+", path.stem)[-1:] for path in files]
    by_name = {path.name: i for i, path in enumerate(files)} | {path.stem: i for i, path in enumerate(files)}
    by_number = {int(number[0]): i for i, number in enumerate(numbers) if number}
    result = {}
    for key in ids:
        index = by_name.get(str(key))
        if index is None:
            index = by_number.get(_number(str(key)))
        if index is None:
            raise InputError(f"the image id {key!r} matches none of the {len(files)} images")
        result[key] = index
    return result


def _number(name: str) -> int:
    digits = re.findall(r"\d+", Path(name).stem)
    if not digits:
        raise InputError(f"the image id {name!r} holds no number")
    return int(digits[-1])


def _images(folder: Path) -> tuple[Path, ...]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    return tuple(list_images(folder))


def _image_size(source: Path, files: Sequence[Path] | None) -> tuple[int, int]:
    if files is not None:
        height, width = read_image(files[0]).shape[:2]
        return width, height
    height, width = next(read_frames(source)).image.shape[:2]
    return width, height


def _pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> pycolmap.Camera:
    params = [fx, fy, cx, cy]
    return pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=width, height=height, params=params, has_prior_focal_length=True
    )


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text: {error}") from error


def _read_table(path: Path, columns: int) -> Array:
    lines = [line.split() for line in _read_text(path).splitlines() if line.strip() and line[0] != "#"]
    try:
        table = np.array(lines, np.float64)
    except ValueError as error:
        raise InputError(f"{path} is not a table of numbers: {error}") from error
    if table.ndim != 2 or table.shape[1] != columns:
        raise InputError(f"{path} has the shape {table.shape}, expected rows of {columns} numbers")
    return table


def _read_tum_list(folder: Path, name: str) -> tuple[Array, tuple[Path, ...]]:
    rows = [
        line.split(maxsplit=1) for line in _read_text(folder / name).splitlines() if line.strip() and line[0] != "#"
    ]
    try:
        stamped = sorted((float(time), folder / path.strip()) for time, path in rows)
    except ValueError as error:
        raise InputError(f"{folder / name} is not a list of `timestamp file`: {error}") from error
    return np.array([time for time, _ in stamped]), tuple(path for _, path in stamped)


def _nearest_in_time(times: Array, wanted: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The row of `times` nearest to each of k wanted times, (k,), and whether it is within 20 ms."""
    if not len(times):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), np.bool_)
    nearest = np.abs(times[None, :] - wanted[:, None]).argmin(axis=1)
    return nearest, np.abs(times[nearest] - wanted) <= _TUM_TOLERANCE_SECONDS


def _from_quaternions(rows: Array) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) and centres (n, 3) of rows ``tx ty tz qx qy qz qw``, world_from_cam."""
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    if not (np.isfinite(rows).all() and (np.abs(norms - 1.0) < 1e-2).all()):
        raise InputError("the true trajectory holds values that are not finite or quaternions not of length 1")
    rotations = [pycolmap.Rotation3d(q / norm).matrix() for q, norm in zip(rows[:, 3:], norms, strict=True)]
    return np.array(rotations).reshape(-1, 3, 3), rows[:, :3].copy()


def _invert(cam_from_world: Array, source: Path) -> tuple[Array, Array]:
    """Rotations world_from_cam (n, 3, 3) and centres (n, 3) of matrices (n, 4, 4)."""
    rotations = _rotations(cam_from_world[:, :3, :3], source).transpose(0, 2, 1)
    return rotations, -np.einsum("nij,nj->ni", rotations, cam_from_world[:, :3, 3])


def _rotations(matrices: Array, source: Path) -> Array:
    """The rotations nearest to matrices (n, 3, 3); an error if they are not nearly orthonormal."""
    rotations = np.array([nearest_rotation(m) for m in matrices]).reshape(-1, 3, 3)
    if not np.abs(rotations - matrices).max(initial=0.0) < 1e-2:
        raise InputError(f"the poses of {source} hold matrices that are not rotations")
    return rotations
