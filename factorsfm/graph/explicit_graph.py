"""A finished result as an explicit GTSAM graph, to which one can add factors of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import A, K, L, T, X
from numpy.typing import NDArray

from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.track_errors import STRETCH
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.graph.factors import (
    HELD,
    affine_prior,
    landmark_prior,
    lens_of,
    lens_projection_factor,
    native_affine,
    native_depth_factor,
    pixel_noise,
    pose_from_camera,
    pose_prior,
    projection_factor,
    virtual_offset,
)
from factorsfm.priors.affine import SCALE_SIGMA
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FREE = 1e3  # standard deviation of what is not constant
_PINNED = 1e-6  # standard deviation of what a calibration shares with the lens, in focal lengths
_WEAK = 100.0  # standard deviation of a point's prior, in units of its distance


class AffineFit(Protocol):
    """Scale and shift of a depth prior (`PriorFit`)."""

    @property
    def scale(self) -> float: ...
    @property
    def shift(self) -> float: ...
    @property
    def sigma(self) -> float: ...


class SolvedFrame(Protocol):
    """A frame with its pose (`FrameResult`)."""

    @property
    def index(self) -> int: ...
    @property
    def cam_from_world(self) -> pycolmap.Rigid3d | None: ...
    @property
    def prior(self) -> AffineFit | None: ...
    @property
    def repeats(self) -> int | None: ...


class Noise(Protocol):
    """Standard deviations of what was observed (`ObservationNoise`)."""

    @property
    def pixel(self) -> Array: ...
    @property
    def track(self) -> Array: ...
    @property
    def prior(self) -> Array: ...
    @property
    def shift(self) -> float: ...


class SolvedShot(Protocol):
    """Poses, points and observations (`Reconstruction`)."""

    @property
    def frames(self) -> Sequence[SolvedFrame]: ...
    @property
    def kind(self) -> ShotKind: ...
    @property
    def points(self) -> Array: ...
    @property
    def track_ids(self) -> Index: ...
    @property
    def observation_frame(self) -> Index: ...
    @property
    def observation_point(self) -> Index: ...
    @property
    def observation_xy(self) -> Array: ...
    @property
    def observation_error(self) -> Array: ...
    @property
    def prior_residual(self) -> Array: ...
    @property
    def noise(self) -> Noise | None: ...
    @property
    def rolled(self) -> Array | None: ...
    @property
    def camera(self) -> pycolmap.Camera: ...
    def camera_of(self, frame: Any, /) -> pycolmap.Camera: ...


def factor_graph(reconstruction: SolvedShot) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The observations of a result as factors, and its poses, points and prior affines as values.

    Variables: the pose ``X(i)`` (`world_from_cam`) of the registered frame with `index` i (that repeats no other), the
    point ``L(j)`` with `track_ids` j, the affine ``A(i)`` of that frame's depth prior (`factors.affine_of_native`), and
    the constant ``T(0)``; the principal point of the calibration ``K(n)`` is the error that a track keeps for 16
    registered frames (`ObservationNoise.track`). Projections are undistorted pixels relative to the principal point, at
    the focal length of `Reconstruction.camera`, where a camera without a rolling shutter has them
    (`Reconstruction.rolled`). The first pose is held, the unit of length only by weak priors on the points; where the
    camera only turns or stands, all positions are that of the first. Control has no factors.

    What was observed weighs what it weighs in the polish, and the values are those of the minimum: Levenberg-Marquardt
    stays within a tenth of the standard deviations of the poses. It stays within four tenths where weak priors of the
    polish decide for lack of parallax, or where poses are fitted to a strong rolling shutter. Once the unit is fixed,
    the standard deviations are those of `FrameResult.covariance`, or up to a tenth smaller where the depth prior
    decides: its values are those without its smooth error.

    Where the noise is unknown (`Reconstruction.noise`), the observations have a Cauchy kernel and the size of their
    residuals, and there is no prior.
    """
    graph, values = measurements(reconstruction)
    first = X(min(frame.index for frame in reconstruction.frames if frame.cam_from_world is not None))
    graph.add(pose_prior(first, values.atPose3(first), HELD))
    return graph, values


def measurements(reconstruction: SolvedShot) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """`factor_graph` without the prior that holds the first pose."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_poses(graph, values, reconstruction)
    for j, point in zip(reconstruction.track_ids.tolist(), reconstruction.points, strict=True):
        values.insert(L(j), point)
        graph.add(landmark_prior(L(j), point, _WEAK * float(np.linalg.norm(point))))
    rows = _registered_rows(reconstruction)
    _add_projections(graph, values, reconstruction, rows)
    _add_depths(graph, values, reconstruction, rows)
    return graph, values


def _registered_rows(r: SolvedShot) -> Index:
    """The observations in frames that have a pose."""
    registered = np.array([frame.cam_from_world is not None for frame in r.frames])
    return np.flatnonzero(registered[r.observation_frame])


def _add_poses(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, r: SolvedShot) -> None:
    """The poses with weak priors, at the place of the first where the camera does not move."""
    first, together = None, gtsam.noiseModel.Diagonal.Sigmas(np.repeat([_FREE, HELD], 3))
    for frame in r.frames:
        if (pose := frame.cam_from_world) is None or frame.repeats is not None:
            continue
        key, value = X(frame.index), pose_from_camera(pose.rotation.matrix(), pose.translation)
        values.insert(key, value)
        graph.add(pose_prior(key, value, _FREE))
        first = key if first is None else first
        if r.kind is not ShotKind.GENERAL and key != first:
            relative = values.atPose3(first).between(value)
            graph.add(gtsam.BetweenFactorPose3(first, key, relative, together))


def _add_projections(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, r: SolvedShot, rows: Index) -> None:
    """The observations `rows` of points, and the errors that their tracks keep."""
    focal, frame_of, point_of = r.camera.mean_focal_length(), r.observation_frame[rows], r.observation_point[rows]
    lens = lens_of(focal)
    observed, predicted, ratio = np.empty((len(rows), 2)), np.empty((len(rows), 2)), np.empty(len(rows))
    seen = r.observation_xy[rows] if r.rolled is None else (r.observation_xy - r.rolled)[rows]
    for i in np.unique(frame_of):
        mine, camera = frame_of == i, r.camera_of(r.frames[i])
        q = r.frames[i].cam_from_world * r.points[point_of[mine]]
        observed[mine] = focal * normalized_from_pixels(camera, seen[mine])
        predicted[mine] = focal * q[:, :2] / q[:, 2:]
        ratio[mine] = focal / camera.mean_focal_length()
    keys = [X(r.frames[i].index) for i in frame_of], [L(j) for j in r.track_ids[point_of].tolist()]
    if r.noise is None:
        sigma = (ratio * coordinate_sigma(r.observation_error[rows])).tolist()
        for xy, s, pose, point in zip(observed, sigma, *keys, strict=True):
            graph.add(projection_factor(xy, pixel_noise(s), pose, point, lens))
        return
    sigma = ratio * r.noise.pixel[rows]
    slid = _slid_calibrations(graph, values, r, rows, predicted - observed, sigma, lens)
    for xy, s, pose, point, n in zip(observed, sigma.tolist(), *keys, slid.tolist(), strict=True):
        pixel = gtsam.noiseModel.Isotropic.Sigma(2, s)
        if n < 0:
            graph.add(projection_factor(xy, pixel, pose, point, lens))
        else:
            graph.add(lens_projection_factor(xy, pixel, pose, point, K(n)))


def _slid_calibrations(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    r: SolvedShot,
    rows: Index,
    residual: Array,
    sigma: Array,
    lens: gtsam.Cal3_S2,
) -> Index:
    """Add the errors that tracks keep as calibrations; (m,) which of them each observation has, -1 for none.

    Args:
        residual: (m, 2) predicted minus observed position; sigma: (m,) pixels.
    """
    assert r.noise is not None
    size = r.noise.track[r.observation_point[rows]]
    rank = np.unique(r.observation_frame[rows], return_inverse=True)[1]
    key = np.where(size > 0, r.observation_point[rows] * len(r.frames) + rank // STRETCH, -1)
    used, slid = np.unique(key, return_inverse=True)
    slid = slid - int(used[0] == -1)
    kept = slid >= 0
    weight = sigma[kept] ** -2.0
    information = np.bincount(slid[kept], weight)
    spread = np.zeros(len(information))
    spread[slid[kept]] = size[kept]
    pull = [np.bincount(slid[kept], weight * residual[kept, axis]) for axis in range(2)]
    shift = -np.stack(pull, 1) / (information + spread**-2.0)[:, None]
    pinned = np.array([_PINNED * lens.fx(), _PINNED * lens.fy(), _PINNED * lens.fx()])
    for n, (x, y) in enumerate(shift.tolist()):
        values.insert(K(n), gtsam.Cal3_S2(lens.fx(), lens.fy(), 0.0, x, y))
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.append(pinned, [spread[n]] * 2))
        graph.add(gtsam.PriorFactorCal3_S2(K(n), lens, sigmas))
    return slid


def _add_depths(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, r: SolvedShot, rows: Index) -> None:
    """The values of the prior at the observations `rows`, with the affines of its maps."""
    values.insert(T(0), virtual_offset())
    graph.add(pose_prior(T(0), virtual_offset(), HELD))
    if r.noise is None:
        return
    rows = rows[np.isfinite(r.prior_residual[rows])]
    for i, frame in enumerate(r.frames):
        fit, pose, mine = frame.prior, frame.cam_from_world, rows[r.observation_frame[rows] == i]
        if fit is None or pose is None or not len(mine):
            continue
        point = r.observation_point[mine]
        predicted = fit.scale / (pose * r.points[point])[:, 2]
        measured = predicted * (1.0 - r.prior_residual[mine]) + fit.shift
        sigma = predicted * r.noise.prior[mine]
        key, typical = A(frame.index), float(np.median(np.abs(measured)))
        values.insert(key, native_affine(fit.scale, fit.shift))
        graph.add(affine_prior(key, fit.scale, 0.0, SCALE_SIGMA * fit.scale, r.noise.shift * typical))
        for j, value, std in zip(r.track_ids[point].tolist(), measured.tolist(), sigma.tolist(), strict=True):
            depth = gtsam.noiseModel.Diagonal.Sigmas(np.array([std, 1e6]))
            graph.add(native_depth_factor(X(frame.index), T(0), L(j), key, value, depth))
