"""Observability of each camera: the share of tracks and prior in its pose, and the drift of a virtual object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.marginals import Marginals, in_scene, scene_weights, tangent_basis
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CameraObservability:
    """The share of the prior in the pose of a camera, and the drift that its uncertainty may cause.

    Information is the inverse of the mean squared error: a share of 0.75 says that the same tracks without the prior
    would leave twice the error. The shares are about the camera's position relative to the scene as a whole: in the
    coordinates (position, orientation, unit of length) in which the points are where they should be in the
    least-squares sense (distant and badly determined ones count less). The pixel slide is relative to the first
    registered camera, like `FrameResult.covariance`. The shares speak of the errors of tracks one by one;
    the slide has the errors that neighbours share, see `shared_errors`.

    Attributes:
        prior_share: what the depth prior adds to the information on the position, ``1 - trace(C) / trace(C0)`` with
            the covariances of the position with and without the prior; NaN where no translation is estimated.
        prior_share_view_axis: the same of the position along the view axis, ``1 - C_zz / C0_zz``.
        triangulation_angle_deg: median over the camera's points of the largest angle between two rays of a point.
        pixel_slide: how far a virtual object may drift against the footage since the first frame because of the
            pose's uncertainty: one standard deviation in the worst direction, pixels, of a static object in front of
            the image centre, at the median depth of the camera's points.
    """

    prior_share: float
    prior_share_view_axis: float
    triangulation_angle_deg: float
    pixel_slide: float


def camera_observability(
    adjustment: BundleAdjustment, marginals: Marginals, covariance: Array
) -> list[CameraObservability]:
    """Observability of each camera of a converged problem.

    Args:
        marginals: of the problem; covariance: (c, c) of its camera side, `in_scene_unit`.
    """
    state, o = adjustment.state, adjustment.observations
    share, share_view_axis = _prior_shares(adjustment, marginals)
    angle = np.degrees(triangulation_angles(state, o))
    near = state.inverse_distance[o.point] / state.camera_points(o.frame, o.point)[:, 2]
    cameras = len(state.rotation)
    depth = 1.0 / np.maximum(_median_by_frame(near, o, cameras), 1e-9)
    columns = [share, share_view_axis, _median_by_frame(angle[o.point], o, cameras)]
    columns.append(pixel_slide(pose_blocks(covariance, len(depth)), depth, state.focal))
    return [CameraObservability(*row) for row in np.stack(columns, 1).tolist()]


def _prior_shares(adjustment: BundleAdjustment, marginals: Marginals) -> tuple[Array, Array]:
    """(k,) shares of the prior in the information on all of a camera's position, and along its view axis."""
    state = adjustment.state
    k = len(state.rotation)
    if not pose_blocks(marginals.camera, k)[:, 3:, 3:].any():
        return np.full(k, np.nan), np.full(k, np.nan)
    if adjustment.prior is None:
        return np.zeros(k), np.zeros(k)
    none = np.zeros(0)
    state = replace(state, scale=none, shift=none, field=none)
    alone = BundleAdjustment(state, adjustment.observations, adjustment.options, adjustment.errors).marginals()
    weights = scene_weights(marginals, state)
    both, geometry = (
        np.einsum("kii->ki", pose_blocks(in_scene(m, state, weights), k))[:, 3:] for m in (marginals, alone)
    )
    return _share(both.sum(1), geometry.sum(1)), _share(both[:, 2], geometry[:, 2])


def _share(variance: Array, without: Array) -> Array:
    """Share of the information that comes from the prior."""
    return np.clip(1.0 - variance / np.maximum(without, 1e-300), 0.0, 1.0)


def pose_blocks(covariance: Array, count: int) -> Array:
    """(count, 6, 6) of the poses in the covariance of a camera side."""
    return np.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])


def triangulation_angles(state: State, observations: Observations) -> Array:
    """(n,) largest angle between two rays of each point (radians), up to 2 % too small."""
    o = observations
    motion = np.einsum("kji,kj->ki", state.rotation, state.translation)
    ray = state.bearing[o.point] + state.inverse_distance[o.point, None] * motion[o.frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    start = o.first
    center = np.add.reduceat(ray, start)
    basis = tangent_basis(center / np.linalg.norm(center, axis=1, keepdims=True))
    flat = np.einsum("mi,mij->mj", ray, basis[o.point])
    widest = np.zeros(len(start))
    for turn in np.arange(8) * np.pi / 8:
        along = flat @ [np.cos(turn), np.sin(turn)]
        widest = np.maximum(widest, np.maximum.reduceat(along, start) - np.minimum.reduceat(along, start))
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * widest, 1.0)))


def pixel_slide(covariance: Array, depth: Array, focal: Array | float) -> Array:
    """Standard deviation, in its worst direction, of the image of a static point on the optical axis.

    Args:
        covariance: (k, 6, 6) of the poses; depth: (k,) of the point; focal: pixels, one or (k,).
    """
    by_pose = np.zeros((len(depth), 2, 6))
    by_pose[:, 0, 1], by_pose[:, 1, 0] = -focal, focal
    by_pose[:, 0, 3] = by_pose[:, 1, 4] = -focal / depth
    image = by_pose @ covariance @ by_pose.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(image)[:, -1], 0.0)))


def _median_by_frame(values: Array, observations: Observations, frames: int) -> Array:
    by_frame = (values[rows] for rows in observations.rows_by_frame(frames))
    return np.array([np.median(mine) if len(mine) else np.nan for mine in by_frame])
