"""A reconstruction and the images that were registered on it, adjusted together and put into one result."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.marginals import in_scene_unit
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.camera.projection import pixels_from_normalized
from factorsfm.imagesets.joint_problem import MatchedImage, Observed, Solved, observed_together, solve
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.polish.observability import camera_observability, pose_blocks
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.parallax import parallax
from factorsfm.support.rotations import camera_centers
from factorsfm.support.similarity import Similarity, align, pose_arrays

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_INLIER_SIGMAS = 8.0  # an observation with a larger reprojection error is no inlier


def extended(
    base: Reconstruction,
    frames: list[FrameResult],
    views: Sequence[MatchedImage],
    mapper: SetMapper,
    local: Similarity,
    *,
    refine: bool,
) -> Reconstruction:
    """The result with the new images.

    Args:
        frames: of the result, and the new ones; those of the result have their poses.
        views: images that were matched; mapper: with an image for each, solved in the world that `local` leads to.
        refine: whether the known cameras are adjusted, too.
    """
    poses = {k: local_pose(pose, local) for k, frame in enumerate(frames) if (pose := frame.cam_from_world) is not None}
    old = set(poses)
    for view, image in zip(views, mapper.images, strict=True):
        if image.registered and view.position not in old:
            poses[view.position] = image.pose
    new = set(poses) - old
    ids, track_points = mapper.points.all()
    places = np.concatenate([local.points(base.points.reshape(-1, 3)), track_points])
    observed = observed_together(base, views, ids, old, new)
    if not refine:  # cameras that are known need not be solved with what they alone see
        seen_anew = observed.point[np.isin(observed.frame, list(new))]
        observed = observed.only(np.isin(observed.point, seen_anew))
    solved = solve(base.camera, observed, poses, places, {min(poses)} if refine else old)
    back = _back(solved, frames, old) if refine else _inverse(local)
    points = _points(base, solved, places, back, new, refine=refine)
    _describe(frames, solved, back, new, refine=refine)
    return _put_together(base, frames, solved, points, _colors(views, ids), new)


def local_pose(pose: pycolmap.Rigid3d, local: Similarity) -> tuple[Array, Array]:
    """Rotation and translation of a `cam_from_world` after the world was changed by `local`."""
    rotation = pose.rotation.matrix() @ local.rotation.T
    return rotation, local.scale * np.asarray(pose.translation) - rotation @ local.translation


def _points(
    base: Reconstruction, solved: Solved, places: Array, back: Similarity, new: Set[int], *, refine: bool
) -> Array:
    """(n, 3) all points in the coordinates of the result; those that no new image sees stay unless all is refined."""
    places = places.copy()
    places[solved.points] = solved.adjustment.state.points
    points = back.points(places)
    if not refine:
        seen_anew = solved.observed_point[np.isin(solved.observed_frame, list(new))]
        rest = np.setdiff1d(np.arange(len(base.points)), seen_anew)
        points[rest] = base.points[rest]
    return points


def _colors(views: Sequence[MatchedImage], ids: Index) -> NDArray[np.uint8]:
    """(n, 3) colours of the mapped tracks."""
    colors = np.zeros((len(ids), 3), np.uint8)
    for view in views:
        mapped = np.isin(view.ids, ids)
        colors[np.searchsorted(ids, view.ids[mapped])] = view.rgb[mapped]
    return colors


def _put_together(
    base: Reconstruction,
    frames: list[FrameResult],
    solved: Solved,
    points: Array,
    track_colors: NDArray[np.uint8],
    new: Set[int],
) -> Reconstruction:
    """The result with its new frames, points and observations.

    Args:
        points: all of them, see `Observed`; track_colors: of those that are not of the result.
    """
    count = len(base.points)
    added = solved.points[solved.points >= count]
    row_of = np.full(len(points), -1)
    row_of[:count], row_of[added] = np.arange(count), count + np.arange(len(added))
    state = solved.adjustment.state
    xy = pixels_from_normalized(base.camera, state.normalized(solved.adjustment.observations))
    used = Observed(solved.observed_frame, solved.observed_point, xy)
    fresh = used.only((used.point >= count) | np.isin(used.frame, list(new)))
    result = replace(
        base,
        frames=frames,
        points=np.concatenate([points[:count], points[added]]),
        colors=np.concatenate([base.colors, track_colors[added - count]]),
        track_ids=np.concatenate([base.track_ids, base.track_ids.max(initial=-1) + 1 + np.arange(len(added))]),
        observation_frame=np.concatenate([base.observation_frame, fresh.frame]),
        observation_point=np.concatenate([base.observation_point, row_of[fresh.point]]),
        observation_xy=np.concatenate([base.observation_xy, fresh.xy]),
        prior_residual=np.concatenate([base.prior_residual, np.full(len(fresh.frame), np.nan)]),
        point_std=None,
        noise=None,
        rolled=None,
        notes=list(base.notes),
        measured=None,  # it has no tracks in the new images
    )
    result.observation_error = _errors(result)
    centers = result.camera_centers()
    result.parallax = parallax(centers, 1.0 / np.linalg.norm(result.points - centers[0], axis=1))
    return result


def _inverse(s: Similarity) -> Similarity:
    return Similarity(1.0 / s.scale, s.rotation.T, -s.rotation.T @ s.translation / s.scale)


def _back(solved: Solved, frames: Sequence[FrameResult], old: Set[int]) -> Similarity:
    """From the adjusted world to the coordinates of the result, in which the known cameras stay as a whole."""
    state = solved.adjustment.state
    rows = [row for row, position in enumerate(solved.positions.tolist()) if position in old]
    centers = camera_centers(state.rotation[rows], state.translation[rows])
    true_rotation, true_centers = pose_arrays([frames[solved.positions[row]].cam_from_world for row in rows])
    return align(state.rotation[rows].transpose(0, 2, 1), centers, true_rotation, true_centers)


def _describe(frames: list[FrameResult], solved: Solved, back: Similarity, new: Set[int], *, refine: bool) -> None:
    """Poses of the frames that are new or refined, and what is known of them."""
    adjustment = solved.adjustment
    state, o = adjustment.state, adjustment.observations
    marginals = adjustment.marginals()
    covariance = in_scene_unit(marginals, state) if refine else marginals.camera
    observability = camera_observability(adjustment, marginals, covariance)
    blocks = pose_blocks(covariance, len(solved.positions))
    blocks[:, 3:] *= back.scale
    blocks[:, :, 3:] *= back.scale
    errors = adjustment.reprojection_errors()
    threshold = _INLIER_SIGMAS * coordinate_sigma(errors)
    for row, position in enumerate(solved.positions.tolist()):
        if not refine and position not in new:
            continue
        frame, mine = frames[position], errors[o.frame == row]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(state.rotation[row]), state.translation[row])
        rotation, translation = local_pose(pose, back)
        frame.cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        frame.covariance, frame.relative_covariance, frame.observability = blocks[row], None, observability[row]
        if position in new:
            frame.inliers, frame.keyframe = int((mine < threshold).sum()), True
            frame.reprojection_error = float(np.median(mine)) if len(mine) else float("nan")
            frame.message = f"{frame.inliers} of {len(mine)} tracks within {threshold:.2f} pixels"


def _errors(result: Reconstruction) -> Array:
    """(m,) reprojection errors of all observations, pixels; NaN in frames that are not registered."""
    errors = np.full(len(result.observation_frame), np.nan)
    for position in np.unique(result.observation_frame):
        pose = result.frames[position].cam_from_world
        mine = result.observation_frame == position
        if pose is None:
            continue
        q = pose * result.points[result.observation_point[mine]]
        off = pixels_from_normalized(result.camera, q[:, :2] / q[:, 2:]) - result.observation_xy[mine]
        errors[mine] = np.linalg.norm(off, axis=1)
    return errors
