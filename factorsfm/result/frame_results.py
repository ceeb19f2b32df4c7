"""The result of each frame, from the polish."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import with_focal
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polished import Polished
from factorsfm.result.reconstruction import FrameResult, PriorFit
from factorsfm.support.similarity import covariance_in_unit
from factorsfm.support.status import FrameStatus, ShotKind

_INLIER_SIGMAS = 8.0  # an observation with a larger reprojection error is no inlier
_MAD_TO_SIGMA = 1.4826


class SourceFrame(Protocol):
    """A frame of the source."""

    @property
    def index(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def timestamp(self) -> float | None: ...


def frame_results(
    polished: Polished,
    images: Sequence[MappedImage],
    frames: Sequence[SourceFrame],
    camera: pycolmap.Camera,
    unit: float,
) -> list[FrameResult]:
    """One result per frame, registered or not.

    Args:
        images, frames: of the source, in the same order.
        camera: the lens after the polish.
        unit: length of one unit of the polish in the result.
    """
    row_of = {position: row for row, position in enumerate(polished.frames)}
    by_frame = polished.observations.rows_by_frame(len(polished.frames))
    results = []
    for position, (frame, image) in enumerate(zip(frames, images, strict=True)):
        result = FrameResult(
            frame.index,
            frame.name,
            frame.timestamp,
            image.status,
            image.message,
            keyframe=image.keyframe,
            observations=len(image.tracks.ids),
        )
        if position in row_of:
            row = row_of[position]
            _add_solution(result, polished, row, polished.errors[by_frame[row]], camera, unit)
            result.prior = _prior_fit(polished, images, row, unit)
        elif position in polished.left_out:
            result.status, result.message = FrameStatus.TOO_FEW_INLIERS, polished.left_out[position]
            result.keyframe = False
        results.append(result)
    return results


def mapped_results(frames: Sequence[SourceFrame], images: Sequence[MappedImage]) -> list[FrameResult]:
    """What has become of the frames of a shot that is not solved, or cannot be."""
    return [
        FrameResult(
            frame.index, frame.name, frame.timestamp, image.status, image.message, pose_of(image),
            image.keyframe, len(image.tracks.ids), image.inliers,
        )
        for frame, image in zip(frames, images, strict=True)
    ]  # fmt: skip


def pose_of(image: MappedImage) -> pycolmap.Rigid3d | None:
    """`cam_from_world` of an image; None where it is not registered."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(image.rotation), image.translation) if image.registered else None


def _add_solution(
    result: FrameResult, polished: Polished, row: int, errors: NDArray[np.float64], camera: pycolmap.Camera, unit: float
) -> None:
    """Add pose, covariance, lens and inliers of a camera.

    Args:
        row: of the camera in the polish; errors: of its observations, pixels.
    """
    state, lens = polished.state, polished.lens
    rotation = pycolmap.Rotation3d(state.rotation[row])
    result.cam_from_world = pycolmap.Rigid3d(rotation, state.translation[row] * unit)
    result.covariance = covariance_in_unit(polished.covariance[row], unit)
    if row > 0:
        result.relative_covariance = covariance_in_unit(polished.relative_covariance[row], unit)
    result.observability = polished.observability[row]
    if len(state.log_focal) > 1:
        result.camera = with_focal(camera, float(state.focal[row]))
        if lens is not None and lens.determined:
            result.focal_std = float(lens.focal_std[state.group[row]])
    threshold = _INLIER_SIGMAS * polished.sigma
    result.inliers = int((errors < threshold).sum())
    result.reprojection_error = float(np.median(errors))
    result.message = f"{result.inliers} of {len(errors)} tracks within {threshold:.2f} pixels"
    if polished.motion.kind is ShotKind.STATIC:
        result.status = FrameStatus.STATIC
        result.message += "; the camera does not move"


def _prior_fit(polished: Polished, images: Sequence[MappedImage], row: int, unit: float) -> PriorFit | None:
    prior = polished.prior
    if prior is None or row not in prior.images:
        return None
    i = int(np.flatnonzero(prior.images == row)[0])
    depth = images[polished.frames[row]].tracks.depth
    assert depth is not None
    residual = prior.residual[prior.observations.image == i]
    return PriorFit(
        scale=float(polished.state.scale[i]) * depth.unit * unit,
        shift=float(polished.state.shift[i]) * depth.unit,
        scale_std=float(prior.scale_std[i]) * depth.unit * unit,
        shift_std=float(prior.shift_std[i]) * depth.unit,
        sigma=_MAD_TO_SIGMA * float(np.median(np.abs(residual))) * depth.unit,
        smooth=float(polished.state.scale[i]) * prior.weight.smooth * depth.unit,
    )
