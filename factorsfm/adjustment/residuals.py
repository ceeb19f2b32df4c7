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
    return np.moveaxis(by_pose_rows(np.moveaxis(by_q, -1, 0), q.T, w), 0, -1)


def by_pose_rows(by_q: Array, q: Array, w: Array) -> Array:
    """As `by_pose`, components first: (3, ..., n), (3, n) and (n,) give (6, ..., n)."""
    (gx, gy, gz), (x, y, z) = by_q, q
    chained = np.empty((6, *by_q.shape[1:]))
    chained[0], chained[1], chained[2] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
    np.multiply(-w, by_q, out=chained[3:])
    return chained


def reprojection(q: Array, observed: Array, focal: Array | float, lens: Array | None = None) -> tuple[Array, Array]:
    """``f distort(q_xy / q_z) - observed``, the paper's E_PR.

    Args:
        q: (n, 3); observed: (n, 2) pixels relative to the principal point; focal: pixels, one or (n,).
        lens: as in `distorted_rows`; None: nothing is distorted.

    Returns:
        Residual (n, 2) in pixels and its derivative by `q` (n, 2, 3).
    """
    projected, by_q = projected_rows(q.T, focal, lens)
    return projected.T - observed, by_q.transpose(2, 1, 0)


def projected_rows(q: Array, focal: Array | float, lens: Array | None = None) -> tuple[Array, Array]:
    """The prediction of `reprojection` and its derivative by `q`, all components rows of their own.

    Args:
        q: (3, n); focal, lens: as in `reprojection`.

    Returns:
        (2, n) pixels relative to the principal point, and (3, 2, n).
    """
    inverse = 1.0 / q[2]
    uv, gain = q[:2] * inverse, focal * inverse
    by_q = np.zeros((3, 2, q.shape[1]))
    if lens is None:
        by_q[0, 0] = by_q[1, 1] = gain
        np.multiply(-gain, uv, out=by_q[2])
        return focal * uv, by_q
    distorted, by_uv = distorted_rows(uv, lens)
    by_q[0, 0], by_q[0, 1], by_q[1, 1] = gain * by_uv
    by_q[1, 0] = by_q[0, 1]
    by_q[2] = -(by_q[0] * uv[0] + by_q[1] * uv[1])
    return focal * distorted, by_q


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
    """`distorted_rows` of points (n, 2), their derivative by `uv` (n, 2, 2) and by `lens` (n, 2, 4)."""
    distorted, by_uv = distorted_rows(uv.T, lens)
    xx, xy, yy = by_uv
    return distorted.T, np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1), by_lens_rows(uv.T).transpose(2, 1, 0)


def distorted_rows(uv: Array, lens: Array) -> tuple[Array, Array]:
    """``u (1 + k1 r^2 + k2 r^4) + c``: radial distortion as COLMAP's RADIAL model has it, and a principal point.

    Beyond 63 degrees off the axis the displacement stays constant: wrong matches that are predicted far outside of the
    image would otherwise decide the distortion.

    Args:
        uv: (2, n) undistorted normalised image coordinates.
        lens: (4,) k1, k2, and the principal point's displacement in focal lengths; what follows is of no concern here.

    Returns:
        (2, n) distorted coordinates, and the elements xx, xy = yx and yy (3, n) of their derivative by `uv`.
    """
    k1, k2, *center = lens[:4].tolist()
    (u, v), (square, share) = uv, _within_reach(uv)
    bend = share * square * (k1 + square * k2)
    change = np.where(share < 1.0, -bend * share**2 / _REACH**2, 2.0 * k1 + 4.0 * k2 * square)
    gain, pull = 1.0 + bend, change * u
    distorted = np.stack([u * gain + center[0], v * gain + center[1]])
    return distorted, np.stack([pull * u + gain, pull * v, change * v * v + gain])


def by_lens_rows(uv: Array) -> Array:
    """(4, 2, n) derivative of `distorted_rows` by the lens, on which it does not depend."""
    square, share = _within_reach(uv)
    by_lens = np.zeros((4, 2, uv.shape[1]))
    by_lens[0] = uv * (share * square)
    by_lens[1] = by_lens[0] * square
    by_lens[2, 0] = by_lens[3, 1] = 1.0
    return by_lens


def _within_reach(uv: Array) -> tuple[Array, Array]:
    """(n,) squared distances from the axis, `_REACH` for those beyond it, and their share of the distance, else 1."""
    square = uv[0] ** 2 + uv[1] ** 2
    beyond = square > _REACH**2
    if not beyond.any():
        return square, np.ones_like(square)
    return np.where(beyond, _REACH**2, square), np.where(beyond, _REACH / np.sqrt(np.maximum(square, _REACH**2)), 1.0)


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
