"""A finished result as an explicit GTSAM graph, to which one can add factors of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.graph.factors import (
    native_affine,
    native_affine_noise,
    native_depth_factor,
    pose_from_camera,
    virtual_offset,
)
from factorsfm.priors.affine import SCALE_SIGMA, SHIFT_SIGMA
from factorsfm.support.options import PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_HELD, _FREE = 1e-6, 1e3  # standard deviations of what is constant, and of what is not
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
    def cam_from_world(self) -> pycolmap.Rigid3d | None: ...
    @property
    def prior(self) -> AffineFit | None: ...


class SolvedShot(Protocol):
    """Poses, points and observations (`Reconstruction`)."""

    @property
    def frames(self) -> Sequence[SolvedFrame]: ...
    @property
    def kind(self) -> ShotKind: ...
    @property
    def points(self) -> Array: ...
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
    def camera_of(self, frame: Any, /) -> pycolmap.Camera: ...


def factor_graph(reconstruction: SolvedShot) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The observations of a result as factors, and its poses, points and prior affines as values.

    Variables: the pose ``X(i)`` (`world_from_cam`) of the registered frame at position i of `frames`, the point
    ``L(j)`` in row j of `points`, the affine ``A(i)`` of that frame's depth prior (`factors.affine_of_native`), and the
    constant ``T(0)``. Projections are undistorted pixels relative to the principal point, with a Cauchy kernel and the
    noise that the result shows. The values of the prior are those without its smooth error; a result that was read back
    has none. The first pose is held, the unit of length only by weak priors on the points. Where the camera only turns
    or stands, all positions are held.

    The factors count observations as independent, which they are not: for uncertainties see `FrameResult.covariance`.
    """
    r, graph, values, noise = reconstruction, gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel
    kernel = noise.mEstimator.Cauchy.Create(PolishOptions().kernel)
    poses = {i: frame.cam_from_world for i, frame in enumerate(r.frames) if frame.cam_from_world is not None}
    for i, pose in poses.items():
        values.insert(X(i), pose_from_camera(pose.rotation.matrix(), pose.translation))
        first, nodal = i == min(poses), r.kind is not ShotKind.GENERAL
        sigmas = np.repeat([_HELD if first else _FREE, _HELD if first or nodal else _FREE], 3)
        graph.add(gtsam.PriorFactorPose3(X(i), values.atPose3(X(i)), noise.Diagonal.Sigmas(sigmas)))
    for j, point in enumerate(r.points):
        values.insert(L(j), point)
        graph.add(gtsam.PriorFactorPoint3(L(j), point, noise.Isotropic.Sigma(3, _WEAK * float(np.linalg.norm(point)))))

    rows = np.flatnonzero(np.isin(r.observation_frame, list(poses)))
    frame_of, point_of = r.observation_frame[rows], r.observation_point[rows]
    sigma = coordinate_sigma(r.observation_error[rows])
    pixel = noise.Robust.Create(kernel, noise.Isotropic.Sigma(2, sigma))
    lenses, pixels = {}, np.empty((len(rows), 2))
    for i in poses:
        mine, camera = frame_of == i, r.camera_of(r.frames[i])
        focal = camera.mean_focal_length()
        lenses[i] = gtsam.Cal3_S2(focal, focal, 0, 0, 0)
        pixels[mine] = focal * normalized_from_pixels(camera, r.observation_xy[rows[mine]])
    for i, j, xy in zip(frame_of.tolist(), point_of.tolist(), pixels, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, pixel, X(i), L(j), lenses[i]))

    values.insert(T(0), virtual_offset())
    graph.add(gtsam.PriorFactorPose3(T(0), virtual_offset(), noise.Isotropic.Sigma(6, _HELD)))
    relative = r.prior_residual[rows]
    repeated = np.bincount(point_of, np.isfinite(relative), len(r.points))  # the images of a point share an error
    for i, pose in poses.items():
        if (fit := r.frames[i].prior) is None:
            continue
        mine = (frame_of == i) & np.isfinite(relative)
        seen = point_of[mine]
        predicted = fit.scale / (pose * r.points[seen])[:, 2]
        affine = native_affine(fit.scale, fit.shift)
        values.insert(A(i), affine)
        typical = SHIFT_SIGMA * float(np.median(predicted))
        graph.add(gtsam.PriorFactorCal3_S2(A(i), affine, native_affine_noise(SCALE_SIGMA * fit.scale, typical)))
        measured = predicted * (1.0 - relative[mine]) + fit.shift
        spread = fit.sigma * np.sqrt(repeated[seen])
        for j, value, std in zip(seen.tolist(), measured.tolist(), spread.tolist(), strict=True):
            depth = noise.Robust.Create(kernel, noise.Diagonal.Sigmas(np.array([std, 1e6])))
            graph.add(native_depth_factor(X(i), T(0), L(j), A(i), value, depth))
    return graph, values
