"""A reconstruction and the images that were registered on it, adjusted together and put into one result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.marginals import in_scene_unit
from factorsfm.adjustment.noise import block_inflation, coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.polish.observability import camera_observability, pose_blocks
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.options import PolishOptions
from factorsfm.support.parallax import parallax
from factorsfm.support.similarity import Similarity, align, pose_arrays

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_SAME_PX = 0.1  # a keypoint this near to an observation is the same
_CELL_PX = 0.5  # in which a keypoint is looked for
_OUTLIER_SIGMAS, _INLIER_SIGMAS = 12.0, 8.0
_OPTIONS = replace(PolishOptions(), iterations=30)


@dataclass(slots=True)
class View:
    """An image that takes part.

    Attributes:
        frame: what is known of it; position: among the frames of the extended result.
        file: its copy; size: (width, height).
        ids: (n,) its tracks, ascending; xy: (n, 2) where they are, in pixels of the result's camera with centres at
            integers; rgb: (n, 3) their colours.
    """

    frame: FrameResult
    position: int
    file: str
    size: tuple[int, int]
    ids: Index
    xy: Array
    rgb: NDArray[np.uint8]


@dataclass(slots=True)
class _Table:
    """Observations of the joint problem: position of the frame, point, pixels. Points of the result come first."""

    frame: Index
    point: Index
    xy: Array

    def only(self, keep: NDArray[np.bool_]) -> _Table:
        return _Table(self.frame[keep], self.point[keep], self.xy[keep])


def local_pose(pose: pycolmap.Rigid3d, local: Similarity) -> tuple[Array, Array]:
    """Rotation and translation of a `cam_from_world` after the world was changed by `local`."""
    rotation = pose.rotation.matrix() @ local.rotation.T
    return rotation, local.scale * np.asarray(pose.translation) - rotation @ local.translation


def extended(
    base: Reconstruction,
    frames: list[FrameResult],
    views: list[View],
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
    old = {row for row, frame in enumerate(frames) if frame.registered}
    new = {view.position: image for view, image in zip(views, mapper.images, strict=True) if view.position not in old}
    new = {position: image for position, image in new.items() if image.registered}
    poses = {row: local_pose(pose, local) for row in old if (pose := frames[row].cam_from_world) is not None}
    poses.update({position: image.pose for position, image in new.items()})

    ids, track_points = mapper.points.all()
    known = _same_points(base, views, ids, old)
    table = _joined(base, views, ids, known, set(poses), set(new))
    count = len(base.points)
    places = np.concatenate([local.points(base.points.reshape(-1, 3)), track_points])
    # Cameras that are known need not be solved with what they alone see.
    wanted = np.zeros(len(places), bool)
    wanted[table.point[np.isin(table.frame, list(new))]] = True
    table = table.only(np.full(len(table.point), True) if refine else wanted[table.point])

    adjustment, positions, points = _solved(base, table, poses, places, old, refine)
    state = adjustment.state
    places[points] = state.points
    back = _back(state, positions, frames, old) if refine else _inverse(local)
    result_points = back.points(places)
    if not refine:
        o = adjustment.observations
        seen_anew = points[o.point[np.isin(np.array(positions)[o.frame], list(new))]]
        rest = np.setdiff1d(np.arange(count), seen_anew)
        result_points[rest] = base.points[rest]
    _describe(frames, adjustment, positions, back, set(new), refine)

    added = points[points >= count]
    colors = np.zeros((len(places), 3), np.uint8)
    for view in views:
        colors[count + np.searchsorted(ids, view.ids[np.isin(view.ids, ids)])] = view.rgb[np.isin(view.ids, ids)]
    row_of = np.full(len(places), -1)
    row_of[:count], row_of[added] = np.arange(count), count + np.arange(len(added))
    o = adjustment.observations
    used = _Table(np.array(positions)[o.frame], points[o.point], pixels_from_normalized(base.camera, o.xy))
    fresh = used.only((used.point >= count) | np.isin(used.frame, list(new)))
    result = replace(
        base,
        frames=frames,
        points=np.concatenate([result_points[:count], result_points[added]]),
        colors=np.concatenate([base.colors, colors[added]]),
        track_ids=np.concatenate([base.track_ids, base.track_ids.max(initial=-1) + 1 + np.arange(len(added))]),
        observation_frame=np.concatenate([base.observation_frame, fresh.frame]),
        observation_point=np.concatenate([base.observation_point, row_of[fresh.point]]),
        observation_xy=np.concatenate([base.observation_xy, fresh.xy]),
        prior_residual=np.concatenate([base.prior_residual, np.full(len(fresh.frame), np.nan)]),
        point_std=None,
        notes=list(base.notes),
    )
    result.observation_error = _errors(result)
    centers = result.camera_centers()
    result.parallax = parallax(centers, 1.0 / np.linalg.norm(result.points - centers[0], axis=1))
    return result


# --- what is solved ---------------------------------------------------------------------------------------------


def _same_points(base: Reconstruction, views: list[View], ids: Index, old: set[int]) -> dict[int, int]:
    """Rows of the mapped tracks (in `ids`) that are points of the result: the same keypoints of its images."""
    same: dict[int, int] = {}
    for view in views:
        if view.position not in old:
            continue
        mine = np.nonzero(base.observation_frame == view.position)[0]
        here = np.nonzero(np.isin(view.ids, ids))[0]
        _, a, b = np.intersect1d(_cells(view.xy[here]), _cells(base.observation_xy[mine]), return_indices=True)
        near = np.linalg.norm(view.xy[here[a]] - base.observation_xy[mine[b]], axis=1) < _SAME_PX
        rows = np.searchsorted(ids, view.ids[here[a[near]]])
        for row, point in zip(rows.tolist(), base.observation_point[mine[b[near]]].tolist(), strict=True):
            same.setdefault(row, point)
    return same


def _cells(xy: Array) -> Index:
    x, y = np.rint(xy / _CELL_PX).astype(np.int64).T
    return np.asarray((y << 32) + x)


def _joined(
    base: Reconstruction, views: list[View], ids: Index, known: dict[int, int], frames: set[int], new: set[int]
) -> _Table:
    """All observations in registered frames: those of the result, and those of tracks that are none of its points."""
    count = len(base.points)
    point_of = count + np.arange(len(ids))
    if known:
        point_of[list(known)] = list(known.values())
    frame, point, xy = [base.observation_frame], [base.observation_point], [base.observation_xy]
    for view in views:
        if view.position not in frames:
            continue
        here = np.nonzero(np.isin(view.ids, ids))[0]
        points = point_of[np.searchsorted(ids, view.ids[here])]
        # What an image of the result sees of its points is there already.
        mine = (points >= count) | (view.position in new)
        points, first = np.unique(points[mine], return_index=True)
        frame.append(np.full(len(points), view.position))
        point.append(points)
        xy.append(view.xy[here[mine][first]])
    table = _Table(np.concatenate(frame), np.concatenate(point), np.concatenate(xy))
    return table.only(np.isin(table.frame, list(frames)))


def _solved(
    base: Reconstruction,
    table: _Table,
    poses: dict[int, tuple[Array, Array]],
    places: Array,
    old: set[int],
    refine: bool,
) -> tuple[BundleAdjustment, list[int], Index]:
    """The adjustment, the positions of its frames and its points; wrong matches are left out after a first pass."""
    positions = sorted(poses)
    held = np.array([p in old for p in positions])
    if refine:
        held = np.arange(len(positions)) == 0
    rotation, translation = (np.array(part) for part in zip(*(poses[p] for p in positions), strict=True))
    focal = base.camera.mean_focal_length()
    uv = normalized_from_pixels(base.camera, table.xy)
    good = np.isfinite(uv).all(axis=1)
    points = np.arange(len(places))
    adjustment, sigma = None, 0.0
    for _ in range(2):
        seen = np.bincount(table.point, good, len(places))
        good &= seen[table.point] >= 2
        order = np.nonzero(good)[0]
        order = order[np.lexsort((table.frame[order], table.point[order]))]
        points, point = np.unique(table.point[order], return_inverse=True)
        observations = Observations(np.searchsorted(positions, table.frame[order]), point.reshape(-1), uv[order])
        distance = np.linalg.norm(places[points], axis=1)
        state = State(rotation, translation, places[points] / distance[:, None], 1.0 / distance, np.log([focal]))
        start = BundleAdjustment(state, observations, _OPTIONS, ErrorModel(1.0), free=Free(held=held))
        sigma = coordinate_sigma(start.reprojection_errors())
        adjustment = BundleAdjustment(state, observations, _OPTIONS, ErrorModel(sigma), free=Free(held=held))
        state = adjustment.solve()
        rotation, translation = state.rotation, state.translation
        places = places.copy()
        places[points] = state.points
        sigma = coordinate_sigma(adjustment.reprojection_errors())
        good[order] = adjustment.reprojection_errors() < _OUTLIER_SIGMAS * sigma
    assert adjustment is not None
    # Errors that neighbours share count once.
    sigma *= float(np.sqrt(block_inflation(adjustment.reprojection_vectors(), adjustment.observations)))
    return (
        BundleAdjustment(adjustment.state, adjustment.observations, _OPTIONS, ErrorModel(sigma), free=Free(held=held)),
        positions,
        np.asarray(points),
    )


# --- the result -------------------------------------------------------------------------------------------------


def _inverse(s: Similarity) -> Similarity:
    return Similarity(1.0 / s.scale, s.rotation.T, -s.rotation.T @ s.translation / s.scale)


def _back(state: State, positions: list[int], frames: list[FrameResult], old: set[int]) -> Similarity:
    """From the adjusted world to the coordinates of the result, in which the known cameras stay as a whole."""
    rows = [row for row, position in enumerate(positions) if position in old]
    centers = -np.einsum("kji,kj->ki", state.rotation[rows], state.translation[rows])
    true_rotation, true_centers = pose_arrays([frames[positions[row]].cam_from_world for row in rows])
    return align(state.rotation[rows].transpose(0, 2, 1), centers, true_rotation, true_centers)


def _describe(
    frames: list[FrameResult],
    adjustment: BundleAdjustment,
    positions: list[int],
    back: Similarity,
    new: set[int],
    refine: bool,
) -> None:
    """Poses of the frames that are new or refined, and what is known of them."""
    state, o = adjustment.state, adjustment.observations
    marginals = adjustment.marginals()
    covariance = in_scene_unit(marginals, state) if refine else marginals.camera
    observability = camera_observability(adjustment, marginals, covariance)
    blocks = pose_blocks(covariance, len(positions))
    blocks[:, 3:] *= back.scale
    blocks[:, :, 3:] *= back.scale
    errors = adjustment.reprojection_errors()
    threshold = _INLIER_SIGMAS * coordinate_sigma(errors)
    for row, position in enumerate(positions):
        if not refine and position not in new:
            continue
        frame, mine = frames[position], errors[o.frame == row]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(state.rotation[row]), state.translation[row])
        rotation, translation = local_pose(pose, back)
        frame.cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        frame.covariance, frame.observability = blocks[row], observability[row]
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
