"""Rotation matrices: cross products, the exponential map and its inverse, projection to SO(3)."""

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


def logarithm(rotations: Array) -> Array:
    """(n, 3) rotation vectors (axis times angle, radians) of (n, 3, 3) rotation matrices, the inverse of `exponential`.

    Through the quaternion of the largest component, so that it holds at every angle up to pi.
    """
    r = rotations
    # Four times the outer product of the quaternion (w, x, y, z) with itself.
    outer = np.empty((len(r), 4, 4))
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    outer[:, 0, 0] = 1.0 + diagonal.sum(axis=1)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, 0, i + 1] = outer[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        outer[:, i + 1, i + 1] = 1.0 + diagonal[:, i] - diagonal[:, j] - diagonal[:, k]
        outer[:, i + 1, j + 1] = outer[:, j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    largest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    quaternion = outer[np.arange(len(r)), largest]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, quaternion[:, 0])
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return np.asarray(factor[:, None] * quaternion[:, 1:])


def right_jacobian(rotation_vector: Array) -> Array:
    """(n, 3, 3) with ``exponential(v + d) = exponential(v) @ exponential(right_jacobian(v) @ d)`` for small d.

    With the rate ``v'`` of a rotation vector, ``right_jacobian(v) @ v'`` is the angular velocity in the body's axes.
    """
    angle = np.linalg.norm(rotation_vector, axis=1)[:, None, None]
    hat = cross_matrices(rotation_vector)
    safe = np.maximum(angle, 1e-3)
    half = np.sinc(angle / 2.0 / np.pi) ** 2 / 2.0
    sixth = np.where(angle > 1e-3, (safe - np.sin(safe)) / safe**3, 1.0 / 6.0 - angle**2 / 120.0)
    return np.asarray(np.eye(3) - half * hat + sixth * (hat @ hat))


def adjoint(rotation: Array, translation: Array) -> Array:
    """(6, 6) that carries perturbations (rotation vector, translation) through a pose: (3, 3) and (3,)."""
    found = np.zeros((6, 6))
    found[:3, :3] = found[3:, 3:] = rotation
    found[3:, :3] = cross_matrices(translation[None])[0] @ rotation
    return found


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix (3, 3) in the Frobenius norm: its projection to SO(3)."""
    u, _, vt = np.linalg.svd(matrix)
    rotation: Array = (u * [1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return rotation


def camera_centers(rotation: Array, translation: Array) -> Array:
    """(n, 3) centres of cameras, from their `cam_from_world` rotations (n, 3, 3) and translations (n, 3)."""
    return np.asarray(-np.einsum("nji,nj->ni", rotation, translation))
