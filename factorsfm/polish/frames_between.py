"""Long shots: which frames are variables of the polish, and the frames between them, registered on its points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.residuals import cauchy
from factorsfm.lens.lens import Lens, LensEstimate
from factorsfm.lens.turning import turn_to
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.registration import register_image
from factorsfm.polish.polished import Polished
from factorsfm.polish.shot import Shot
from factorsfm.support.options import Options
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pose = tuple[Array, Array]


def solved_frames(images: list[MappedImage], registered: list[int], limit: int) -> list[int]:
    """The frames that are variables of the polish: all, or in a long shot the keyframes and others between them."""
    if len(registered) <= limit:
        return registered
    keyframes = [i for i in registered if images[i].keyframe]
    if len(keyframes) > limit:
        return [keyframes[k] for k in np.linspace(0, len(keyframes) - 1, limit).astype(int)]
    others = [i for i in registered if not images[i].keyframe]
    fill = [others[k] for k in np.linspace(0, len(others) - 1, limit - len(keyframes)).astype(int)]
    return sorted(keyframes + fill)


def too_few_tracks(count: int, least: int) -> str:
    """Why a frame is left out."""
    return f"{count} of {least} needed tracks agree with those of the other frames in the polish"


def add_frames_between(result: Polished, shot: Shot, registered: list[int], options: Options) -> None:
    """Register the frames that were left out on the polished points."""
    group = shot.group[registered]
    if result.lens is not None and len(result.lens.lens.focal) > len(shot.guess.focal):  # a zoom
        group = np.arange(len(registered))
        result.lens = _zoom_at(result.lens, result.frames, np.array(registered))
        result.state = replace(result.state, log_focal=np.log(result.lens.lens.focal))
    cameras = replace(result.state, group=group)
    seen = shot.observations(registered, result.tracks)
    if result.shutter is not None:
        seen = shot.swept(seen, registered, result.tracks)
    poses = _registered_between(result, registered, seen, cameras.normalized(seen), cameras.focal, options)
    _insert(result, poses, registered, group, seen, options)


def _zoom_at(lens: LensEstimate, frames: list[int], wanted: Index) -> LensEstimate:
    """The lens at some images, of a zoom that is known at others."""
    return replace(
        lens,
        lens=Lens(np.exp(np.interp(wanted, frames, np.log(lens.lens.focal))), lens.lens.shape),
        focal_std=np.interp(wanted, frames, lens.focal_std),
    )


def _registered_between(
    result: Polished, registered: list[int], seen: Observations, xy: Array, focal: Array, options: Options
) -> dict[int, Pose]:
    """Poses by position, those of the result among them.

    Args:
        seen: in the registered frames; xy: (m, 2) normalised; focal: (registered,) pixels.
    """
    state, m, solved = result.state, options.mapper, np.array(result.frames)
    points = state.points
    poses = {f: (state.rotation[k], state.translation[k]) for k, f in enumerate(result.frames)}
    for row, f in enumerate(registered):
        if f in poses:
            continue
        mine = np.nonzero(seen.frame == row)[0]
        if len(mine) < m.min_inliers:
            result.left_out[f] = too_few_tracks(len(mine), m.min_inliers)
            continue
        near = poses[int(solved[np.argmin(np.abs(solved - f))])]
        if result.motion.kind is ShotKind.GENERAL:
            found = register_image(
                points[seen.point[mine]], xy[mine], *near,
                focal=float(focal[row]), sigma=max(result.sigma, SMALLEST_SIGMA_PX), inlier_px=m.inlier_px,
            )  # fmt: skip
            pose, inliers = (found.rotation, found.translation), int(found.inliers.sum())
        else:
            pose, inliers = _turned(state.bearing[seen.point[mine]], xy[mine], near[0], float(focal[row]), m.inlier_px)
        if inliers >= m.min_inliers:
            poses[f] = pose
        else:
            result.left_out[f] = f"{inliers} of {m.min_inliers} needed inliers among {len(mine)} tracks of the polish"
    return poses


def _turned(bearing: Array, xy: Array, near: Array, focal: float, inlier_px: float) -> tuple[Pose, int]:
    """The pose of a camera that does not translate, and the number of its inliers."""
    ray = np.column_stack([xy, np.ones(len(xy))])
    rotation = turn_to(bearing, ray / np.linalg.norm(ray, axis=1, keepdims=True), near, focal)
    q = bearing @ rotation.T
    error = focal * np.linalg.norm(q[:, :2] / q[:, 2:] - xy, axis=1)
    return (rotation, np.zeros(3)), int(((error < inlier_px) & (q[:, 2] > 0.0)).sum())


def _insert(
    result: Polished, poses: dict[int, Pose], registered: list[int], group: Index, seen: Observations, options: Options
) -> None:
    """Put the frames between into the result.

    Each is as certain as the nearest solved one, and relative to the frame before as the following solved one is
    relative to its own. Their observations have the kernel's weights.
    """
    frames, solved = sorted(poses), np.array(result.frames)
    nearest = np.argmin(np.abs(np.array(frames)[:, None] - solved), axis=1)
    result.state = replace(
        result.state,
        rotation=np.array([poses[f][0] for f in frames]),
        translation=np.array([poses[f][1] for f in frames]),
        group=group[np.isin(registered, frames)],
    )
    result.covariance = result.covariance[nearest]
    following = np.clip(np.searchsorted(solved, frames), 1, len(solved) - 1)
    result.relative_covariance = result.relative_covariance[following]
    result.observability = [result.observability[k] for k in nearest]
    if result.prior is not None:
        p, new_row = result.prior, np.searchsorted(frames, solved)
        p.images = new_row[p.images]
        p.observations = replace(p.observations, frame=new_row[p.observations.frame])
    result.frames = frames
    position = np.array(registered)[seen.frame]
    kept = np.isin(position, frames)
    result.observations = seen.at(kept, frame=np.searchsorted(frames, position[kept]))
    result.errors = BundleAdjustment(
        result.state, result.observations, options.polish, ErrorModel(result.sigma)
    ).reprojection_errors()
    weight = cauchy(result.errors[:, None] / result.sigma, options.polish.kernel)[1]
    result.observation_sigma = result.observation_sigma.min() / np.sqrt(weight)
