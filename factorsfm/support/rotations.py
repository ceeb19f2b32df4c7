"""Rotation matrices: cross products, the exponential map, projection to SO(3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cross_matrices(vectors: Array) -> Array:
    """(n, 3, 3) skew-symmetric matrices: ``cross_matrices(v)[i] @ w`` is ``cross(v[i], w)``, for (n, 3) vectors."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)


def exponential(rotation_vector: Array) -> Array:
    """(n, 3, 3) rotation matrices of (n, 3) rotation vectors (axis times angle, radians), by Rodrigues' formula."""
    angle = np.linalg.norm(rotation_vector, axis=1)[:, None, None]
    hat = cross_matrices(rotation_vector)
    safe = np.maximum(angle, 1e-8)
    half = np.sinc(angle / 2.0 / np.pi) ** 2 / 2.0
    return np.asarray(np.eye(3) + np.sin(safe) / safe * hat + half * (hat @ hat))


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix (3, 3) in the Frobenius norm: its projection to SO(3)."""
    u, _, vt = np.linalg.svd(matrix)
    rotation: Array = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return rotation


def camera_centers(rotation: Array, translation: Array) -> Array:
    """(n, 3) centres of cameras, from their `cam_from_world` rotations (n, 3, 3) and translations (n, 3)."""
    return np.asarray(-np.einsum("nji,nj->ni", rotation, translation))
