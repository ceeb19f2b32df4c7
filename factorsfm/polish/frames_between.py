"""Long shots: which frames are variables of the polish, and the frames between them, registered on its points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.residuals import cauchy
from factorsfm.adjustment.state import State
from factorsfm.lens.lens import Lens, LensEstimate
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polished import Polished
from factorsfm.polish.pose_on_points import Pose, poses_on_points
from factorsfm.polish.shot import Shot
from factorsfm.support.options import Options
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
    poses = _registered_between(result, shot, registered, seen, cameras, options)
    _insert(result, poses, registered, group, seen, options)


def _zoom_at(lens: LensEstimate, frames: list[int], wanted: Index) -> LensEstimate:
    """The lens at some images, of a zoom that is known at others."""
    return replace(
        lens,
        lens=Lens(np.exp(np.interp(wanted, frames, np.log(lens.lens.focal))), lens.lens.shape),
        focal_std=np.interp(wanted, frames, lens.focal_std),
    )


def _registered_between(
    result: Polished, shot: Shot, registered: list[int], seen: Observations, cameras: State, options: Options
) -> dict[int, Pose]:
    """Poses by position, those of the result among them.

    Args:
        seen: in the registered frames; cameras: with the lens of these.
    """
    registering, state = shot.registering(options.mapper), result.state
    least = registering.min_inliers
    poses = {f: (state.rotation[k], state.translation[k]) for k, f in enumerate(result.frames)}
    between = poses_on_points(
        state, np.searchsorted(registered, result.frames), seen, cameras, shot.turns(registered),
        moves=result.motion.kind is ShotKind.GENERAL, sigma=result.sigma, options=registering,
    )  # fmt: skip
    for found in between:
        position = registered[found.row]
        if found.tracks < least:
            result.left_out[position] = too_few_tracks(found.tracks, least)
        elif found.inliers < least:
            result.left_out[position] = (
                f"{found.inliers} of {least} needed inliers among {found.tracks} tracks of the polish"
            )
        else:
            poses[position] = found.pose
    return poses


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
