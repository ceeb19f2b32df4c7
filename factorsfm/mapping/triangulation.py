"""Triangulation of many tracks at once: two-view DLT hypotheses, RANSAC over the views, refinement of the points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.residuals import camera_points, reprojection
from factorsfm.adjustment.state import State
from factorsfm.graph.points_alone import solve_points
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]

_TRIALS = 6


@dataclass(frozen=True, slots=True)
class Triangulation:
    """Points of tracks.

    Attributes:
        bearing (n, 3) unit and inverse_distance (n,): the points, as in `State`.
        inliers: (n,) views that agree with the point.
        angle: (n,) sine of the largest angle between its first ray and another, nearly this angle (radians).
    """

    bearing: Array
    inverse_distance: Array
    inliers: NDArray[np.int64]
    angle: Array

    def points(self, good: NDArray[np.bool_]) -> Array:
        """(k, 3) those of the (n,) tracks that are good, at a positive distance."""
        return self.bearing[good] / self.inverse_distance[good, None]


def triangulate(
    cameras: State,
    observations: Observations,
    *,
    inlier_px: float,
    sigma: float,
    fallback: Array,
    affine: Array | None = None,
    prior: PriorObservations | None = None,
    in_graph: bool = False,
) -> Triangulation:
    """DLT in RANSAC, then ``min over P of sum E_PR + lambda E_DC`` with cameras and affines fixed (paper, 3.3).

    Args:
        cameras: poses and lens of the views.
        observations: sorted by point; every point has at least one.
        fallback: (n,) inverse distance along the first ray where the views leave it open (small angle).
        affine, prior: (images, 2) scale and shift, and the values they scale; None without a prior.
        inlier_px, sigma: pixels.
        in_graph: whether GTSAM solves for the points, where there is a prior: the same minimum, in five times the time.
    """
    o, start = observations, observations.first
    xy = cameras.normalized(o)
    rays = np.einsum("nji,nj->ni", cameras.rotation[o.frame], np.concatenate([xy, np.ones((len(xy), 1))], 1))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first, view = rays[start], o.frame[start]
    angle = np.maximum.reduceat(np.linalg.norm(np.cross(rays, first[o.point]), axis=1), start)
    center = -np.einsum("nji,nj->ni", cameras.rotation[view], cameras.translation[view])
    guess = _homogeneous(first + fallback[:, None] * center, fallback)
    found = _best_supported(cameras, o, xy, guess, inlier_px)
    distance = np.linalg.norm(found[:, :3], axis=1)
    state = replace(cameras, bearing=found[:, :3] / distance[:, None], inverse_distance=found[:, 3] / distance)
    if affine is not None:
        state = replace(state, scale=affine[:, 0], shift=affine[:, 1], field=np.zeros(1))
    if in_graph and prior is not None:
        state = solve_points(state, o, sigma, prior)
    else:
        options = replace(PolishOptions(), iterations=8)
        state = BundleAdjustment(state, o, options, ErrorModel(sigma), prior=prior, free=Free(cameras=False)).solve()
    error = _errors(cameras, o, xy, _homogeneous(state.bearing, state.inverse_distance), inlier_px)
    inliers = np.add.reduceat((error < inlier_px).astype(np.int64), start)
    return Triangulation(state.bearing, state.inverse_distance, inliers, angle)


def _best_supported(cameras: State, o: Observations, xy: Array, guess: Array, inlier_px: float) -> Array:
    """(n, 4) of the guess and of a few two-view points of each track, the one that all of its views fit best.

    Args:
        xy: (m, 2) of the observations, normalised; guess: (n, 4) homogeneous.
    """
    start, count = o.first, np.diff(np.append(o.first, len(o.point)))
    hypotheses = [guess]
    rng = np.random.default_rng(0)
    for trial in range(_TRIALS):
        a = start if trial == 0 else start + rng.integers(0, count)
        b = start + count - 1 if trial == 0 else start + rng.integers(0, count)
        hypotheses.append(_two_view(cameras, o.frame, xy, a, b))
    stacked = np.stack(hypotheses)
    errors = [np.minimum(_errors(cameras, o, xy, points, inlier_px), inlier_px) for points in stacked]
    best = np.argmin([np.add.reduceat(error, start) for error in errors], axis=0)
    return np.asarray(stacked[best, np.arange(len(start))])


def _homogeneous(direction: Array, inverse_distance: Array) -> Array:
    return np.concatenate([direction, inverse_distance[:, None]], 1)


def _two_view(cameras: State, frame: NDArray[np.int64], xy: Array, a: NDArray[np.int64], b: NDArray[np.int64]) -> Array:
    """(n, 4) homogeneous DLT points of one pair of observations per point, in front of the first camera."""
    camera = np.concatenate([cameras.rotation, cameras.translation[:, :, None]], 2)
    rows = []
    for side in (a, b):
        p = camera[frame[side]]
        rows += [xy[side, :1] * p[:, 2] - p[:, 0], xy[side, 1:] * p[:, 2] - p[:, 1]]
    point = np.linalg.svd(np.stack(rows, 1))[2][:, 3]
    depth = np.einsum("ni,ni->n", camera[frame[a], 2], point)
    # A homogeneous point and its negative are the same: choose the one in front, at positive or negative distance.
    return np.where(depth[:, None] < 0.0, -point, point)


def _errors(cameras: State, o: Observations, xy: Array, points: Array, limit: float) -> Array:
    """(m,) reprojection errors (undistorted pixels) of homogeneous points; large beyond infinity or behind a camera."""
    rotation, translation = cameras.rotation[o.frame], cameras.translation[o.frame]
    q = camera_points(rotation, translation, points[o.point, :3], points[o.point, 3])
    front = (q[:, 2] > 1e-9) & (points[o.point, 3] > 0.0)
    error = np.full(len(q), 10.0 * limit)
    focal = cameras.focal[o.frame][front]
    error[front] = np.linalg.norm(reprojection(q[front], focal[:, None] * xy[front], focal)[0], axis=1)
    return error
