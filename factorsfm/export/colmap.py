"""The sparse model as COLMAP's text or binary files, for COLMAP, pycolmap, Gaussian-splat trainers and others."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.export.image_names import image_name
from factorsfm.export.shot import Shot
from factorsfm.export.training import seen_in_training, write_training_images
from factorsfm.result.reconstruction import Reconstruction


class _Observations(NamedTuple):
    """The observations to write, sorted by frame: arrays (k,), and `xy` (k, 2)."""

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    place: NDArray[np.int64]  # position in the image's list of 2-D points
    xy: NDArray[np.float64]  # pixel centres at 0.5
    error: NDArray[np.float64]


def write_colmap(reconstruction: Reconstruction, folder: str | Path) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; the folder is made if absent.

    There is one camera for each lens of the registered frames. The image id is the frame index + 1, the point id that
    of its track + 1. Points seen from fewer than two registered frames are left out. Pixel centres
    are at 0.5, as everywhere in COLMAP. The text format cannot hold white space in an image name. If a name has some,
    the binary files are written as well, which readers prefer.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    observations = _observations(reconstruction)
    cameras = _cameras(reconstruction)
    lenses = [
        _join((camera_id, camera.model_name, camera.width, camera.height, *map(_exact, camera.params)))
        for camera_id, camera in enumerate(cameras, 1)
    ]
    _write_lines(folder / "cameras.txt", "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", lenses)
    _write_lines(
        folder / "images.txt",
        "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; next line: POINTS2D[] as (X, Y, POINT3D_ID)",
        _image_lines(reconstruction, observations, cameras),
    )
    _write_lines(
        folder / "points3D.txt",
        "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
        _point_lines(reconstruction, observations),
    )

    names = {frame.index + 1: image_name(frame.name) for frame in reconstruction.frames}
    if any(name.split() != [name] for name in names.values()):
        model = pycolmap.Reconstruction(folder)
        for image_id, image in model.images.items():
            image.name = names[image_id]
        _write_binary(model, folder)


def write_colmap_binary(reconstruction: Reconstruction, folder: str | Path) -> None:
    """Write ``cameras.bin``, ``images.bin``, ``points3D.bin`` and COLMAP's further files; content as `write_colmap`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as text:
        write_colmap(reconstruction, text)
        _write_binary(pycolmap.Reconstruction(text), folder)


def _write_binary(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model, and check that all of it has been written: pycolmap says nothing of a full disk.

    COLMAP may never come to an end with a file that is cut off, so that the files are not read back.

    Raises:
        OSError: a file is cut off.
    """
    model.write_binary(folder)
    # COLMAP's format: a count, then numbers of 4 or 8 bytes and names that end in 0.
    expected = {
        "cameras.bin": 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values()),
        "images.bin": 8 + sum(73 + len(i.name.encode()) + 24 * len(i.points2D) for i in model.images.values()),
        "points3D.bin": 8 + sum(51 + 8 * point.track.length() for point in model.points3D.values()),
    }
    for name, size in expected.items():
        if (written := (folder / name).stat().st_size) < size:
            raise OSError(f"only {written} of {size} bytes of {name} are written; is the disk full?")


def write_colmap_training(shot: Shot, folder: Path, write: Callable[[Reconstruction, Path], None]) -> None:
    """Write a folder for training: the model in ``sparse/0``, and images and masks as `write_training_images` does.

    Args:
        write: `write_colmap` or `write_colmap_binary`.
    """
    new = seen_in_training(shot)
    write_training_images(shot, new, folder)
    write(new, folder / "sparse" / "0")


def _observations(reconstruction: Reconstruction) -> _Observations:
    """Observations in registered frames of points that at least two of them see."""
    frame, point = reconstruction.observation_frame, reconstruction.observation_point
    registered = np.array([f.registered for f in reconstruction.frames], bool)
    views = np.bincount(point[registered[frame]], minlength=len(reconstruction.points))
    rows = np.flatnonzero(registered[frame] & (views[point] >= 2))
    rows = rows[np.argsort(frame[rows], kind="stable")]
    first_of_frame = np.searchsorted(frame[rows], np.arange(len(registered)))
    return _Observations(
        frame=frame[rows],
        point=point[rows],
        place=np.arange(len(rows)) - first_of_frame[frame[rows]],
        xy=reconstruction.observation_xy[rows] + 0.5,
        error=reconstruction.observation_error[rows],
    )


def _cameras(reconstruction: Reconstruction) -> list[pycolmap.Camera]:
    """The different lenses of the registered frames."""
    cameras: list[pycolmap.Camera] = []
    for camera in map(reconstruction.camera_of, reconstruction.registered):
        if camera not in cameras:
            cameras.append(camera)
    return cameras or [reconstruction.camera]


def _image_lines(
    reconstruction: Reconstruction, observations: _Observations, cameras: list[pycolmap.Camera]
) -> list[str]:
    points2d = [
        f"{x:.6f} {y:.6f} {track + 1}"
        for (x, y), track in zip(
            observations.xy.tolist(), reconstruction.track_ids[observations.point].tolist(), strict=True
        )
    ]
    bounds = np.searchsorted(observations.frame, np.arange(len(reconstruction.frames) + 1))
    lines = []
    for frame, start, stop in zip(reconstruction.frames, bounds[:-1], bounds[1:], strict=True):
        if frame.cam_from_world is not None:
            qx, qy, qz, qw = frame.cam_from_world.rotation.quat
            pose = map(_exact, (qw, qx, qy, qz, *frame.cam_from_world.translation))
            camera_id = 1 + cameras.index(reconstruction.camera_of(frame))
            lines.append(_join((frame.index + 1, *pose, camera_id, _on_one_line(image_name(frame.name)))))
            lines.append(_join(points2d[start:stop]))
    return lines


def _point_lines(reconstruction: Reconstruction, observations: _Observations) -> list[str]:
    image_ids = np.array([frame.index + 1 for frame in reconstruction.frames], np.int64)
    order = np.argsort(observations.point, kind="stable")
    tracks = [
        f"{image_id} {place}"
        for image_id, place in zip(
            image_ids[observations.frame[order]].tolist(), observations.place[order].tolist(), strict=True
        )
    ]
    points, starts = np.unique(observations.point[order], return_index=True)
    stops = np.append(starts, len(tracks))[1:]
    errors = _mean_errors(observations, len(reconstruction.points))
    lines = []
    for point, start, stop in zip(points, starts, stops, strict=True):
        xyz = map(_exact, reconstruction.points[point])
        rgb = reconstruction.colors[point]
        lines.append(
            _join((reconstruction.track_ids[point] + 1, *xyz, *rgb, f"{errors[point]:.6g}", *tracks[start:stop]))
        )
    return lines


def _mean_errors(observations: _Observations, count: int) -> NDArray[np.float64]:
    """(count,) mean reprojection error of each point; -1, COLMAP's "unknown", without observations."""
    known = np.isfinite(observations.error)
    number = np.bincount(observations.point[known], minlength=count)
    total = np.bincount(observations.point[known], observations.error[known], minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), -1.0)


def _on_one_line(name: str) -> str:
    return re.sub(r"[\t-\r]", "_", name)


def _exact(value: float) -> str:
    return f"{value:.17g}"


def _join(values: Iterable[object]) -> str:
    return " ".join(map(str, values))


def _write_lines(path: Path, columns: str, lines: list[str]) -> None:
    path.write_text("\n".join([f"# {columns}", *lines, ""]), encoding="utf-8")
