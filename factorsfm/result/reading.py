"""A result folder, read back."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import camera_from_json
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.result.reconstruction import FrameResult, PriorFit, Reconstruction
from factorsfm.result.summary import part_name
from factorsfm.support.errors import InputError
from factorsfm.support.program import PROGRAM
from factorsfm.support.status import FrameStatus, ShotKind


def read_result(directory: str | Path) -> Reconstruction:
    """Read what `Reconstruction.write` has written.

    Poses, points, colours and the lens come back exactly, observations to a millionth of a pixel. What the files do
    not hold is missing: covariances, the tracks' identities (here: the points' rows), the prior's residuals (NaN),
    observations in frames that are not registered, and points that fewer than two registered frames see.

    Raises:
        InputError: the folder holds no result, that of a shot that could not be reconstructed, or a damaged one.
    """
    directory = Path(directory)
    content = _summary(directory)
    try:
        model = pycolmap.Reconstruction(directory / "colmap")
        result = _reconstruction(content, model)
    except (OSError, ValueError, KeyError, TypeError, IndexError, RuntimeError) as error:
        raise InputError(f"the result in {directory} is damaged: {error}") from error
    result.others = [read_result(directory / part_name(number)) for number in range(2, content.get("parts", 1) + 1)]
    return result


def _summary(directory: Path) -> dict[str, Any]:
    path = directory / "summary.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{directory} holds no result of factorsfm reconstruct: there is no summary.json") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict) or content.get("program") != PROGRAM:
        raise InputError(f"{directory} holds no result of factorsfm reconstruct: its summary.json is not factorsfm's")
    if not content.get("reconstructed"):
        raise InputError(f"the shot in {directory} could not be reconstructed: {content.get('reason')}")
    return content


def _reconstruction(content: dict[str, Any], model: pycolmap.Reconstruction) -> Reconstruction:
    images = {image_id - 1: image for image_id, image in model.images.items()}
    own = len(model.cameras) > 1
    frames = [_frame(status, images, own=own) for status in content["statuses"]]
    point_ids = sorted(model.points3D)
    row_of_point = {point_id: row for row, point_id in enumerate(point_ids)}
    points = [model.points3D[point_id] for point_id in point_ids]
    camera = camera_from_json(content["camera"]) if own else _copy(next(iter(model.cameras.values())))

    frame_of, point_of, xy, error = [], [], [np.empty((0, 2))], [np.empty(0)]
    for position, frame in enumerate(frames):
        if frame.cam_from_world is None:
            continue
        seen = [point2d for point2d in images[frame.index].points2D if point2d.has_point3D()]
        rows = [row_of_point[point2d.point3D_id] for point2d in seen]
        if not rows:
            continue
        pixels = np.array([point2d.xy for point2d in seen])
        frame_of += [position] * len(rows)
        point_of += rows
        xy.append(pixels - PIXEL_CENTER)
        in_camera = frame.cam_from_world * np.array([points[row].xyz for row in rows])
        error.append(np.linalg.norm((frame.camera or camera).img_from_cam(in_camera) - pixels, axis=1))
    return Reconstruction(
        camera=camera,
        frames=frames,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        track_ids=np.arange(len(points)),
        observation_frame=np.array(frame_of, np.int64),
        observation_point=np.array(point_of, np.int64),
        observation_xy=_joined(xy),
        observation_error=_joined(error),
        prior_residual=np.full(len(frame_of), np.nan),
        kind=ShotKind(content["kind"]),
        parallax=_number(content["parallax"]),
        metric=content["metric"],
        control=_control(content["control"]),
        notes=content["notes"],
        seconds=content["seconds"],
        options=content["options"],
    )


def _frame(status: dict[str, Any], images: dict[int, pycolmap.Image], *, own: bool) -> FrameResult:
    """`own`: whether the frames have lenses of their own."""
    prior = status["prior"]
    return FrameResult(
        index=status["index"],
        name=status["name"],
        timestamp=status["timestamp"],
        status=FrameStatus(status["status"]),
        message=status["message"],
        cam_from_world=images[status["index"]].cam_from_world() if status["registered"] else None,
        keyframe=status["keyframe"],
        observations=status["observations"],
        inliers=status["inliers"],
        reprojection_error=_number(status["reprojection_error"]),
        prior=prior and PriorFit(**{name: _number(value) for name, value in prior.items()}),
        camera=_copy(images[status["index"]].camera) if own and status["registered"] else None,
        focal_std=status.get("focal_std"),
    )


def _control(content: dict[str, Any] | None) -> ControlFit | None:
    if content is None:
        return None
    residuals = [ControlResidual(**residual) for residual in content["residuals"]]
    stds = _number(content["scale_std"]), _number(content["position_std"])
    return ControlFit(residuals, content["held"], content["unused"], content["placed"], *stds)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _joined(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate(parts)


def _copy(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A camera that outlives its model."""
    return pycolmap.Camera(camera.todict())
