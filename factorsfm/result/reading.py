"""A result folder, read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import camera_from_json, camera_to_json
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.control.fit import ControlFit
from factorsfm.inertial.fit import ImuFit
from factorsfm.motion.stretches import Stretch
from factorsfm.polish.observability import CameraObservability
from factorsfm.result.alignment import Alignment
from factorsfm.result.moving import read_moving
from factorsfm.result.objects import read_objects
from factorsfm.result.reconstruction import FrameResult, LensFit, PriorFit, Reconstruction, RollingShutter
from factorsfm.result.summary import part_name
from factorsfm.result.tracks_file import read_tracks
from factorsfm.support.errors import InputError
from factorsfm.support.file_names import check_name
from factorsfm.support.json_reading import read_json, typed
from factorsfm.support.program import PROGRAM
from factorsfm.support.status import FrameStatus, ShotKind

_MOST_FRAMES = 10**9  # more than any film has; numbers of frames stay within 32 bits in all exports


@dataclass(frozen=True, slots=True)
class _Status:
    """What summary.json says of a frame."""

    index: int
    name: str
    timestamp: float | None
    status: FrameStatus
    message: str
    registered: bool
    keyframe: bool
    observations: int
    inliers: int
    reprojection_error: float
    prior: PriorFit | None
    observability: CameraObservability | None
    focal_std: float | None
    repeats: int | None = None


@dataclass(frozen=True, slots=True)
class _Stretch:
    """What summary.json says of a stretch."""

    frames: list[int]
    kind: ShotKind

    def read(self) -> Stretch:
        first, last = self.frames
        return Stretch(first, last, self.kind)


@dataclass(frozen=True, slots=True)
class _Summary:
    """What summary.json says that the other files do not."""

    camera: dict[str, Any]
    lens: LensFit | None
    shutter: RollingShutter | None
    kind: ShotKind
    parallax: float
    metric: bool
    control: ControlFit | None
    imu: ImuFit | None
    notes: list[str]
    seconds: dict[str, float]
    options: dict[str, Any]
    parts: int
    statuses: list[_Status]
    doubts: list[str] = field(default_factory=list)
    stretches: list[_Stretch] = field(default_factory=list)
    alignment: Alignment | None = None


def read_result(directory: str | Path) -> Reconstruction:
    """Read what `Reconstruction.write` has written.

    Poses, points, colours and the lens come back exactly, observations to a millionth of a pixel. What the files do
    not hold is missing: covariances, the observations' noise, the prior's residuals (NaN), observations in frames that
    are not registered, and points that fewer than two registered frames see.

    Raises:
        InputError: the folder holds no result, an incomplete or a damaged one, or that of a shot that could not be
            reconstructed.
    """
    directory = Path(directory)
    content = _content(directory)
    try:
        summary = typed(_Summary, content, "summary.json")
        result = _reconstruction(summary, pycolmap.Reconstruction(directory / "colmap"))
        result.objects = read_objects(directory / "objects.json")
        result.moving = read_moving(directory / "moving.json")
        result.measured = read_tracks(directory / "tracks.npz")
    except (InputError, OSError, ValueError, LookupError, RuntimeError) as error:
        raise InputError(f"the result in {directory} is damaged: {error}") from error
    result.others = [read_result(directory / part_name(number)) for number in range(2, summary.parts + 1)]
    return result


def _content(directory: Path) -> dict[str, Any]:
    """The summary of a result, of which no more is known than that it is one."""
    if not (directory / "summary.json").is_file():
        raise InputError(f"{directory} holds no result of factorsfm reconstruct: there is no summary.json")
    content = read_json(directory / "summary.json", "the summary")
    if not isinstance(content, dict) or content.get("program") != PROGRAM:
        raise InputError(f"{directory} holds no result of factorsfm reconstruct: its summary.json is not factorsfm's")
    if content.get("incomplete"):
        raise InputError(f"the result in {directory} is incomplete: {content.get('reason')}")
    if not content.get("reconstructed"):
        raise InputError(f"the shot in {directory} could not be reconstructed: {content.get('reason')}")
    return content


def _reconstruction(summary: _Summary, model: pycolmap.Reconstruction) -> Reconstruction:
    if not model.cameras or not summary.statuses:
        raise InputError("it has no camera or no frame")
    own = len(model.cameras) > 1
    camera = camera_from_json(summary.camera) if own else _copy(next(iter(model.cameras.values())))
    images = {image_id - 1: image for image_id, image in model.images.items()}
    frames = [_frame(status, images, own=own) for status in summary.statuses]
    row_of_point = {point_id: row for row, point_id in enumerate(sorted(model.points3D))}
    points = [model.points3D[point_id] for point_id in row_of_point]
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    if not np.isfinite(xyz).all():
        raise InputError("a point is not finite")
    seen = [_seen(frame, images, row_of_point) for frame in frames]
    pixels = np.concatenate([np.empty((0, 2)), *(xy for _, xy in seen)])
    errors = [
        np.linalg.norm((frame.camera or camera).img_from_cam(frame.cam_from_world * xyz[rows]) - xy, axis=1)
        for frame, (rows, xy) in zip(frames, seen, strict=True)
        if frame.cam_from_world is not None and len(rows)
    ]
    return Reconstruction(
        camera=camera,
        frames=frames,
        points=xyz,
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        track_ids=np.array([*row_of_point], np.int64) - 1,
        observation_frame=np.repeat(np.arange(len(frames)), [len(rows) for rows, _ in seen]),
        observation_point=np.concatenate([np.empty(0, np.int64), *(rows for rows, _ in seen)]),
        observation_xy=pixels - PIXEL_CENTER,
        observation_error=np.concatenate([np.empty(0), *errors]),
        prior_residual=np.full(len(pixels), np.nan),
        kind=summary.kind,
        stretches=tuple(stretch.read() for stretch in summary.stretches),
        parallax=summary.parallax,
        lens=summary.lens,
        shutter=summary.shutter,
        metric=summary.metric,
        control=summary.control,
        imu=summary.imu,
        alignment=summary.alignment,
        doubts=summary.doubts,
        notes=summary.notes,
        seconds=summary.seconds,
        options=summary.options,
    )


def _frame(status: _Status, images: Mapping[int, pycolmap.Image], *, own: bool) -> FrameResult:
    """`own`: whether the frames have lenses of their own."""
    check_name(status.name)
    if not 0 <= status.index < _MOST_FRAMES:
        raise InputError(f"the index of a frame is {status.index}; 0 to {_MOST_FRAMES - 1} is expected")
    image = images[status.index] if status.registered else None
    pose = None if image is None else image.cam_from_world()
    if pose is not None and not np.isfinite(pose.matrix()).all():
        raise InputError(f"the pose of frame {status.index} is not finite")
    return FrameResult(
        index=status.index,
        name=status.name,
        timestamp=status.timestamp,
        status=status.status,
        message=status.message,
        cam_from_world=pose,
        keyframe=status.keyframe,
        observations=status.observations,
        inliers=status.inliers,
        reprojection_error=status.reprojection_error,
        prior=status.prior,
        observability=status.observability,
        camera=_copy(image.camera) if image is not None and own else None,
        focal_std=status.focal_std,
        repeats=status.repeats,
    )


def _seen(
    frame: FrameResult, images: Mapping[int, pycolmap.Image], row_of_point: Mapping[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(n,) rows of the points that a frame sees, and (n, 2) where, in COLMAP's pixels."""
    keypoints = images[frame.index].points2D if frame.registered else []
    seen = [keypoint for keypoint in keypoints if keypoint.has_point3D()]
    rows = np.array([row_of_point[keypoint.point3D_id] for keypoint in seen], np.int64)
    return rows, np.array([keypoint.xy for keypoint in seen], np.float64).reshape(-1, 2)


def _copy(camera: pycolmap.Camera) -> pycolmap.Camera:
    """A camera that outlives its model, if it is one that a camera file might hold."""
    camera_from_json(camera_to_json(camera))
    return pycolmap.Camera(camera.todict())
