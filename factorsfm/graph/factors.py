"""The residuals of the factor graph, each defined once with its analytic derivatives, and their GTSAM forms.

Points are homogeneous, ``(m, w)`` with ``P = m / w``: ``w = 1`` is the Euclidean point of the incremental graph, a unit
``m`` with ``w = 1 / distance`` is the inverse-distance point of the polish. Everything starts from the camera-frame
vector ``q = R m + w t``, so that the depth is ``q_z / w``.

Pose derivatives use GTSAM's convention: ``world_from_cam`` is perturbed on the right by ``xi = (omega, v)``, which
moves ``q`` by ``q x omega - w v``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.residuals import (
    _along_z,
    affine_depth,
    affine_inverse_depth,
    by_pose,
    camera_points,
    cauchy,
    reprojection,
)

Array = NDArray[np.float64]

# Lateral displacement of the virtual camera of `native_depth_factor`, in units of the median depth of the map: the
# model error of that factor is x / VIRTUAL_BASELINE for a point at lateral position x.
VIRTUAL_BASELINE = 1e4
# --- GTSAM forms ------------------------------------------------------------------------------------------------

Residual = Callable[[gtsam.Values], tuple[Array, list[Array]]]


def _whole_image_factor(keys: list[int], rows: int, function: Residual) -> gtsam.CustomFactor:
    """A unit-noise `CustomFactor` from a function that returns the residual and one Jacobian per key."""

    def error(this: Any, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, blocks = function(values)
        if jacobians is not None:
            for slot, block in enumerate(blocks):
                # GTSAM reads the array without looking at its shape.
                if block.shape[0] != rows:
                    raise ValueError(f"Jacobian {slot} has {block.shape[0]} rows, expected {rows}")
                jacobians[slot] = np.asfortranarray(block)
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)


def _robust_rows(residual: Array, blocks: list[Array], kernel: float) -> tuple[Array, list[Array]]:
    """Residual rows whose half squared norm is the Cauchy cost and whose Jacobian gives its exact gradient."""
    cost, weight = cauchy(residual, kernel)
    norm = np.maximum(np.linalg.norm(residual, axis=1), 1e-12)
    stretch = np.where(norm < 1e-9, 1.0, np.sqrt(2.0 * cost) / norm)
    gain = (weight / stretch)[:, None, None]
    rows = (residual * stretch[:, None]).ravel()
    return rows, [(block * gain).reshape(len(rows), -1) for block in blocks]


def camera_from_pose(pose: gtsam.Pose3) -> tuple[Array, Array]:
    """`cam_from_world` rotation and translation of a GTSAM pose (`world_from_cam`)."""
    rotation = pose.rotation().matrix().T
    return rotation, -rotation @ pose.translation()


def pose_from_camera(rotation: Array, translation: Array) -> gtsam.Pose3:
    """GTSAM pose (`world_from_cam`) of a `cam_from_world` rotation and translation."""
    return gtsam.Pose3(gtsam.Rot3(rotation.T), -rotation.T @ translation)


def image_reprojection_factor(
    pose_key: int, points: Array, observed: Array, focal: float, sigma: float, kernel: float
) -> gtsam.CustomFactor:
    """All reprojections of one image on its pose, the points held fixed; Cauchy kernel per observation.

    Args:
        points: (n, 3); observed: (n, 2) undistorted normalised coordinates; focal, sigma: pixels.
        kernel: Cauchy scale in standard deviations.
    """
    w = np.ones(len(points))
    pixels = focal * observed

    def function(values: gtsam.Values) -> tuple[Array, list[Array]]:
        q = camera_points(*camera_from_pose(values.atPose3(pose_key)), points, w)
        q[:, 2] = np.maximum(q[:, 2], 1e-6)
        residual, by_q = reprojection(q, pixels, focal)
        block = by_pose(by_q.transpose(1, 0, 2), q, w).transpose(1, 0, 2)
        return _robust_rows(residual / sigma, [block / sigma], kernel)

    return _whole_image_factor([pose_key], 2 * len(points), function)


def image_depth_factor(
    pose_key: int,
    affine_key: int,
    points: Array,
    measured: Array,
    sigma: Array,
    kernel: float,
    *,
    domain: str,
) -> gtsam.CustomFactor:
    """All depth-consistency residuals of one image on its pose and affine, the points held fixed.

    Args:
        measured: (n,) inverse depth for ``domain="inverse"`` (residual `affine_inverse_depth`), depth for
            ``domain="depth"`` (`affine_depth`, the paper's).
        sigma: (n,) standard deviations in the unit of the residual.
    """
    w = np.ones(len(points))

    def function(values: gtsam.Values) -> tuple[Array, list[Array]]:
        q = camera_points(*camera_from_pose(values.atPose3(pose_key)), points, w)
        q[:, 2] = np.maximum(q[:, 2], 1e-6)
        scale, shift = values.atVector(affine_key)
        if domain == "inverse":
            residual, by_z, _ = affine_inverse_depth(q, w, scale, shift, measured)
            by_affine = np.stack([1.0 / q[:, 2], w], -1)
        else:
            residual, by_z = affine_depth(q, scale, shift, measured)
            by_affine = np.stack([-measured, -w], -1)
        blocks = [(b / sigma[:, None])[:, None] for b in (by_pose(_along_z(by_z), q, w), by_affine)]
        return _robust_rows((residual / sigma)[:, None], blocks, kernel)

    return _whole_image_factor([pose_key, affine_key], len(points), function)


def depth_consistency_factor(
    pose_key: int, point_key: int, affine_key: int, measured: float, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """One depth-consistency residual on (pose, Euclidean point, affine): the readable form.

    In a large graph use `native_depth_factor`, its equal: every call of a Python factor copies all variables.
    """
    one = np.ones(1)

    def error(this: Any, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        rotation, translation = camera_from_pose(values.atPose3(pose_key))
        q = camera_points(rotation, translation, values.atPoint3(point_key)[None], one)
        scale, shift = values.atVector(affine_key)
        residual, by_z, _ = affine_inverse_depth(q, one, scale, shift, np.array([measured]))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_pose(_along_z(by_z), q, one))
            jacobians[1] = np.asfortranarray(by_z[:, None] * rotation[2:3])
            jacobians[2] = np.asfortranarray([[1.0 / q[0, 2], 1.0]])
        return residual

    return gtsam.CustomFactor(noise, [pose_key, point_key, affine_key], error)


def native_depth_factor(
    pose_key: int,
    offset_key: int,
    point_key: int,
    affine_key: int,
    measured: float,
    noise: gtsam.noiseModel.Base,
) -> gtsam_unstable.ProjectionFactorPPPCCal3_S2:
    """The same residual in C++: the u-coordinate in a virtual camera displaced sideways by `VIRTUAL_BASELINE`.

    The affine is a `Cal3_S2` variable (`native_affine`), the displacement the constant pose `virtual_offset`; the
    second row of `noise` (the v-coordinate, without meaning) must have a large sigma.
    """
    return gtsam_unstable.ProjectionFactorPPPCCal3_S2(
        np.array([measured, 0.0]), noise, pose_key, offset_key, point_key, affine_key
    )


def virtual_offset() -> gtsam.Pose3:
    """Pose of the virtual camera in the real one."""
    return gtsam.Pose3(gtsam.Rot3(), np.array([-VIRTUAL_BASELINE, 0.0, 0.0]))


def native_affine(scale: float, shift: float) -> gtsam.Cal3_S2:
    """Scale and shift as the calibration of the virtual camera."""
    return gtsam.Cal3_S2(scale / VIRTUAL_BASELINE, 1.0, 0.0, shift, 0.0)


def affine_of_native(affine: gtsam.Cal3_S2) -> tuple[float, float]:
    """Inverse of `native_affine`."""
    return affine.fx() * VIRTUAL_BASELINE, affine.px()


# (5, 2) derivative of `native_affine` by scale and shift.
NATIVE_BY_AFFINE = np.zeros((5, 2))
NATIVE_BY_AFFINE[0, 0], NATIVE_BY_AFFINE[3, 1] = 1.0 / VIRTUAL_BASELINE, 1.0


def native_affine_noise(scale_sigma: float, shift_sigma: float) -> gtsam.noiseModel.Base:
    """Noise of a prior on a native affine; what has no meaning is pinned."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([scale_sigma / VIRTUAL_BASELINE, 1e-6, 1e-6, shift_sigma, 1e-6]))


# --- the keyframe graph -------------------------------------------------------------------------------------------

_PINNED_PX = 1e-3  # standard deviation of what does not count in a lens, pixels: less makes the system ill-conditioned
KERNEL = 2.0  # Cauchy scale of measurements, standard deviations
HELD = 1e-6  # standard deviation of what is constant


def _robust(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Robust:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(KERNEL), noise)


def pixel_noise(sigma: float) -> gtsam.noiseModel.Robust:
    """Of an observation: `sigma` (pixels) of each coordinate, in a Cauchy kernel."""
    return _robust(gtsam.noiseModel.Isotropic.Sigma(2, sigma))


@lru_cache(1024)
def depth_noise(sigma: float) -> gtsam.noiseModel.Robust:
    """Of `native_depth_factor`: `sigma` in the unit of the prior, in a Cauchy kernel; the second row means nothing."""
    return _robust(gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma, 1e6])))


def projection_factor(
    pixels: Array, noise: gtsam.noiseModel.Base, pose_key: int, point_key: int, lens: gtsam.Cal3_S2
) -> gtsam.GenericProjectionFactorCal3_S2:
    """Reprojection residual on (pose, landmark), `residuals.reprojection`.

    Args:
        pixels: (2,) undistorted observation relative to the principal point of `lens`.
    """
    return gtsam.GenericProjectionFactorCal3_S2(pixels, noise, pose_key, point_key, lens)


def lens_projection_factor(
    pixels: Array, noise: gtsam.noiseModel.Base, pose_key: int, point_key: int, lens_key: int
) -> gtsam.GeneralSFMFactor2Cal3_S2:
    """The same residual with the lens as a variable, too."""
    return gtsam.GeneralSFMFactor2Cal3_S2(pixels, noise, pose_key, point_key, lens_key)


def lens_of(focal: float) -> gtsam.Cal3_S2:
    """A lens without distortion, the principal point at 0."""
    return gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)


def lens_prior(key: int, focal: float, sigma: float) -> gtsam.PriorFactorCal3_S2:
    """Prior of a lens around one focal length for both axes, `sigma` in pixels; the rest is pinned."""
    covariance = np.diag(np.full(5, _PINNED_PX**2))
    covariance[:2, :2] += sigma**2
    return gtsam.PriorFactorCal3_S2(key, lens_of(focal), gtsam.noiseModel.Gaussian.Covariance(covariance))


def constant_projection_factor(
    camera: gtsam.PinholePoseCal3_S2, pixels: Array, noise: gtsam.noiseModel.Base, point_key: int
) -> gtsam.TriangulationFactorPoseCal3_S2:
    """The same residual of a camera that does not change, on the landmark alone."""
    return gtsam.TriangulationFactorPoseCal3_S2(camera, pixels, noise, point_key)


def pose_prior(key: int, pose: gtsam.Pose3, sigma: float) -> gtsam.PriorFactorPose3:
    """Prior of a pose around its value, `sigma` in radians and units of length alike."""
    return gtsam.PriorFactorPose3(key, pose, gtsam.noiseModel.Isotropic.Sigma(6, sigma))


def landmark_prior(key: int, point: Array, sigma: float) -> gtsam.PriorFactorPoint3:
    """Prior of a landmark around its value (3,), `sigma` in units of length."""
    return gtsam.PriorFactorPoint3(key, point, gtsam.noiseModel.Isotropic.Sigma(3, sigma))


def affine_prior(
    key: int, scale: float, shift: float, scale_sigma: float, shift_sigma: float
) -> gtsam.PriorFactorCal3_S2:
    """Prior of a native affine around a scale and a shift."""
    return gtsam.PriorFactorCal3_S2(key, native_affine(scale, shift), native_affine_noise(scale_sigma, shift_sigma))
