"""The residuals, each defined once with its analytic derivatives."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]

_REACH = 2.0  # of the polynomial of a distortion, in normalised coordinates: 63 degrees off the axis


# --- definitions ------------------------------------------------------------------------------------------------


def camera_points(rotation: Array, translation: Array, m: Array, w: Array) -> Array:
    """``q = R m + w t``: (n, 3). Rotation and translation (`cam_from_world`) broadcast over the points."""
    return np.asarray(np.einsum("...ij,...j->...i", rotation, m) + w[..., None] * translation)


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


def reprojection(q: Array, observed: Array, focal: Array | float, lens: Array | None = None) -> tuple[Array, Array]:
    """``f distort(q_xy / q_z) - observed``, the paper's E_PR.

    Args:
        q: (n, 3); observed: (n, 2) pixels relative to the principal point; focal: pixels, one or (n,).
        lens: as in `distort`; None: nothing is distorted.

    Returns:
        Residual (n, 2) in pixels and its derivative by `q` (n, 2, 3).
    """
    inverse = 1.0 / q[:, 2]
    gain = focal * inverse
    projected = q[:, :2] * gain[:, None]
    by_q = np.zeros((len(q), 2, 3))
    by_q[:, 0, 0] = by_q[:, 1, 1] = gain
    by_q[:, :, 2] = -projected * inverse[:, None]
    if lens is not None:
        uv, by_uv, _ = distort(q[:, :2] * inverse[:, None], lens)
        projected, by_q = np.reshape(focal, (-1, 1)) * uv, by_uv @ by_q
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

    Beyond 63 degrees off the axis the displacement stays constant: wrong matches that are predicted far outside of the
    image would otherwise decide the distortion.

    Args:
        uv: (n, 2) undistorted normalised image coordinates.
        lens: (4,) k1, k2, and the principal point's displacement in focal lengths; what follows is of no concern here.

    Returns:
        (n, 2) distorted coordinates, their derivative by `uv` (n, 2, 2) and by `lens` (n, 2, 4).
    """
    k1, k2, *center = lens[:4]
    square = np.einsum("ni,ni->n", uv, uv)[:, None]
    radius = np.sqrt(np.maximum(square, _REACH**2))  # of those beyond
    outside, square, share = square > _REACH**2, np.minimum(square, _REACH**2), _REACH / radius
    bend = share * square * (k1 + square * k2)
    gain = 1.0 + bend
    by_uv = np.einsum("ni,nj->nij", uv * np.where(outside, -bend / radius**2, 2.0 * k1 + 4.0 * k2 * square), uv)
    by_uv[:, [0, 1], [0, 1]] += gain
    by_lens = np.zeros((len(uv), 2, 4))
    by_lens[:, :, 0], by_lens[:, :, 1] = uv * share * square, uv * share * square**2
    by_lens[:, [0, 1], [2, 3]] = 1.0
    return uv * gain + center, by_uv, by_lens


def undistort(uv: Array, lens: Array) -> Array:
    """Inverse of `distort`: (n, 2) undistorted coordinates, NaN where there are none."""
    k1, k2, x, y = lens[:4].tolist()
    if not any((k1, k2, x, y)):
        return uv
    camera = pycolmap.Camera(model="RADIAL", width=1, height=1, params=[1.0, x, y, k1, k2])
    return np.asarray(camera.cam_from_img(uv), np.float64)


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
