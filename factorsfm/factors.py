"""The residuals of the factor graph, each defined once with its analytic derivatives, and their GTSAM forms.

Points are homogeneous, ``(m, w)`` with ``P = m / w``: ``w = 1`` is the Euclidean point of the incremental graph, a unit
``m`` with ``w = 1 / distance`` is the inverse-distance point of the polish. Everything starts from the camera-frame
vector ``q = R m + w t``, so that the depth is ``q_z / w``.

Pose derivatives use GTSAM's convention: ``world_from_cam`` is perturbed on the right by ``xi = (omega, v)``, which
moves ``q`` by ``q x omega - w v``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Lateral displacement of the virtual camera of `native_depth_factor`, in units of the median depth of the map: the
# model error of that factor is x / VIRTUAL_BASELINE for a point at lateral position x.
VIRTUAL_BASELINE = 1e4


# --- definitions ------------------------------------------------------------------------------------------------


def camera_points(rotation: Array, translation: Array, m: Array, w: Array) -> Array:
    """``q = R m + w t``: (n, 3). Rotation and translation (`cam_from_world`) broadcast over the points."""
    return np.asarray(np.einsum("...ij,...j->...i", rotation, m) + w[..., None] * translation)


def cross_matrices(vectors: Array) -> Array:
    """(n, 3, 3) matrices of the cross product by each vector."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)


def exponential(rotation_vector: Array) -> Array:
    """(n, 3, 3) rotation matrices of (n, 3) rotation vectors."""
    angle = np.linalg.norm(rotation_vector, axis=1)[:, None, None]
    hat = cross_matrices(rotation_vector)
    safe = np.maximum(angle, 1e-8)
    half = np.sinc(angle / 2.0 / np.pi) ** 2 / 2.0
    return np.asarray(np.eye(3) + np.sin(safe) / safe * hat + half * (hat @ hat))


def by_pose(by_q: Array, q: Array, w: Array) -> Array:
    """Chain a derivative by `q` to the pose perturbation (omega, v).

    Args:
        by_q: (..., n, 3), last axis the components of `q`; q: (n, 3); w: (n,).

    Returns:
        (..., n, 6).
    """
    gx, gy, gz = np.moveaxis(by_q, -1, 0)
    x, y, z = q.T
    turn = [gy * z - gz * y, gz * x - gx * z, gx * y - gy * x]
    return np.stack([*turn, -w * gx, -w * gy, -w * gz], -1)


def reprojection(q: Array, observed: Array, focal: Array | float) -> tuple[Array, Array]:
    """``f q_xy / q_z - observed``, the paper's E_PR with undistorted observations.

    Args:
        q: (n, 3); observed: (n, 2) pixels relative to the principal point; focal: pixels, one or (n,).

    Returns:
        Residual (n, 2) in pixels and its derivative by `q` (n, 2, 3).
    """
    inverse = 1.0 / q[:, 2]
    gain = focal * inverse
    projected = q[:, :2] * gain[:, None]
    by_q = np.zeros((len(q), 2, 3))
    by_q[:, 0, 0] = by_q[:, 1, 1] = gain
    by_q[:, :, 2] = -projected * inverse[:, None]
    return projected - observed, by_q


def projection_by_pose(q: Array, focal: float) -> tuple[Array, Array]:
    """The prediction of `reprojection`, and its derivative chained by `by_pose`, for Euclidean points.

    All components are rows of their own, with which numpy is several times faster: registration asks at every frame.

    Args:
        q: (3, n), in front of the camera; focal: pixels.

    Returns:
        (2, n) pixels relative to the principal point, and (6, 2, n).
    """
    inverse = 1.0 / q[2]
    u, v = q[0] * inverse, q[1] * inverse
    along, across = focal * u, focal * v
    by_pose = np.zeros((6, 2, q.shape[1]))
    by_pose[0, 0], by_pose[1, 0], by_pose[2, 0] = along * v, -focal - along * u, across
    by_pose[0, 1], by_pose[1, 1], by_pose[2, 1] = focal + across * v, -across * u, -along
    by_pose[3, 0] = by_pose[4, 1] = -focal * inverse
    by_pose[5, 0], by_pose[5, 1] = along * inverse, across * inverse
    return np.stack([along, across]), by_pose


def distort(uv: Array, lens: Array) -> tuple[Array, Array, Array]:
    """``u (1 + k1 r^2 + k2 r^4) + c``: radial distortion as COLMAP's RADIAL model has it, and a principal point.

    Args:
        uv: (n, 2) undistorted normalised image coordinates.
        lens: (4,) k1, k2, and the principal point's displacement in focal lengths; what follows is of no concern here.

    Returns:
        (n, 2) distorted coordinates, their derivative by `uv` (n, 2, 2) and by `lens` (n, 2, 4).
    """
    k1, k2, *center = lens[:4]
    square = np.einsum("ni,ni->n", uv, uv)[:, None]
    gain = 1.0 + square * (k1 + square * k2)
    by_uv = np.einsum("ni,nj->nij", uv * (2.0 * k1 + 4.0 * k2 * square), uv)
    by_uv[:, [0, 1], [0, 1]] += gain
    by_lens = np.zeros((len(uv), 2, 4))
    by_lens[:, :, 0], by_lens[:, :, 1] = uv * square, uv * square**2
    by_lens[:, [0, 1], [2, 3]] = 1.0
    return uv * gain + center, by_uv, by_lens


def affine_inverse_depth(
    q: Array, w: Array, scale: Array | float, shift: Array | float, measured: Array
) -> tuple[Array, Array, Array]:
    """``a w / q_z + b - d``: the depth-consistency residual in the domain of the measurement.

    The state predicts the prior's value, so that shrinking or flattening the scene does not pay.

    Returns:
        Residual (n,), its derivative by `q_z` (n,) and by `w` (n,); those by `a` and `b` are ``w / q_z`` and 1.
    """
    inverse = 1.0 / q[:, 2]
    by_w = scale * inverse
    return by_w * w + shift - measured, -by_w * w * inverse, by_w


def affine_depth(q: Array, gamma: float, beta: float, depth: Array) -> tuple[Array, Array]:
    """``q_z - gamma D - beta``: the paper's E_DC (equations 2 and 3), for Euclidean points.

    It has a trivial minimum when pose, points and affine are all free; only one of them may be solved for at a time.

    Returns:
        Residual (n,) and its derivative by `q_z` (n,); those by gamma and beta are ``-D`` and -1.
    """
    return q[:, 2] - gamma * depth - beta, np.ones(len(q))


def _along_z(by_z: Array) -> Array:
    """A derivative by `q_z` as one by `q`."""
    return np.stack([np.zeros_like(by_z), np.zeros_like(by_z), by_z], -1)


def cauchy(residual: Array, scale: float) -> tuple[Array, Array]:
    """Cauchy kernel on (n, r) residuals.

    Returns:
        Robust cost (n,) and weight (n,) of iteratively re-weighted least squares.
    """
    squared = np.einsum("ni,ni->n", residual, residual) / scale**2
    return 0.5 * scale**2 * np.log1p(squared), 1.0 / (1.0 + squared)


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


def native_affine_noise(scale_sigma: float, shift_sigma: float) -> gtsam.noiseModel.Base:
    """Noise of a prior on a native affine; what has no meaning is pinned."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([scale_sigma / VIRTUAL_BASELINE, 1e-6, 1e-6, shift_sigma, 1e-6]))
