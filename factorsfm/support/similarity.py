"""Similarity transforms, and the alignment of an estimated trajectory to the true one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.support.errors import InputError
from factorsfm.support.rotations import cross_matrices, nearest_rotation

Array = NDArray[np.float64]

_COLLINEAR = 1e-4  # second over first singular value of the centres, below which they lie on a line
_COINCIDENT = 1e-9  # extent over the largest coordinate, below which the centres are one point


@dataclass(frozen=True, slots=True)
class Similarity:
    """``x_truth = scale * rotation @ x_estimate + translation``.

    Attributes:
        scale: truth units per estimate unit.
        rotation: (3, 3).
        translation: (3,), truth units.
    """

    scale: float
    rotation: Array
    translation: Array

    def points(self, points: Array) -> Array:
        """Points (n, 3) of the estimate in the world of the truth."""
        return self.scale * points @ self.rotation.T + self.translation

    def rotations(self, world_from_cam: Array) -> Array:
        """Rotations world_from_cam (n, 3, 3) of the estimate in the world of the truth."""
        return self.rotation @ world_from_cam


def covariance_in_unit(covariance: Array, unit: float) -> Array:
    """A covariance (6, 6) of rotation and translation, in the axes of the camera, with lengths `unit` times as long."""
    units = np.repeat([1.0, unit], 3)
    return np.asarray(covariance * np.outer(units, units))


def registered_frames(centers: Array) -> NDArray[np.bool_]:
    """(n,) whether each camera centre (n, 3) is known; those of unregistered frames are NaN."""
    return np.asarray(np.isfinite(centers).all(axis=-1))


def check_trajectories(
    rotations: Array, centers: Array, true_rotations: Array, true_centers: Array
) -> tuple[Array, Array, Array, Array]:
    """The four arrays as float64; a frame whose rotation or centre is not finite becomes NaN in both.

    Raises:
        InputError: shapes other than (n, 3, 3) and (n, 3) with the same n, or truth that is not finite.
    """
    arrays = [np.asarray(a, np.float64) for a in (rotations, centers, true_rotations, true_centers)]
    n = len(arrays[3])
    for name, array, shape in zip(
        ("rotations", "centers", "true rotations", "true centers"),
        arrays,
        ((n, 3, 3), (n, 3)) * 2,
        strict=True,
    ):
        if array.shape != shape:
            raise InputError(f"{name} have the shape {array.shape}, expected {shape}")
    if not (np.isfinite(arrays[2]).all() and np.isfinite(arrays[3]).all()):
        raise InputError("the true trajectory holds values that are not finite")
    known = registered_frames(arrays[1]) & np.isfinite(arrays[0]).all(axis=(1, 2))
    arrays[0] = np.where(known[:, None, None], arrays[0], np.nan)
    arrays[1] = np.where(known[:, None], arrays[1], np.nan)
    return arrays[0], arrays[1], arrays[2], arrays[3]


def pose_arrays(cam_from_world: Sequence[pycolmap.Rigid3d | None]) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) world_from_cam and centres (n, 3) of poses; NaN where a pose is None."""
    rotations, centers = (
        np.full((len(cam_from_world), 3, 3), np.nan),
        np.full((len(cam_from_world), 3), np.nan),
    )
    for i, pose in enumerate(cam_from_world):
        if pose is not None:
            inverse = pose.inverse()
            rotations[i], centers[i] = inverse.rotation.matrix(), inverse.translation
    return rotations, centers


def align(
    rotations: Array,
    centers: Array,
    true_rotations: Array,
    true_centers: Array,
    scale: float | None = None,
) -> Similarity:
    """The similarity that maps estimated camera centres to the true ones with the least squared error.

    It comes from the centres alone (Umeyama 1991), except where they do not determine the rotation. If the centres lie
    on a line, the camera rotations determine the angle about it; if they coincide, the camera rotations determine the
    whole rotation. Where the estimate or the truth does not move, the scale is 1.

    Args:
        rotations, true_rotations: (n, 3, 3) world_from_cam; unregistered frames NaN.
        centers, true_centers: (n, 3); unregistered frames NaN.
        scale: held at this value (a metric reconstruction, or one scaled by known depths); None estimates it.

    Raises:
        InputError: no frame is registered, or the shapes do not agree.
    """
    rotations, centers, true_rotations, true_centers = check_trajectories(
        rotations, centers, true_rotations, true_centers
    )
    use = registered_frames(centers)
    if not use.any():
        raise InputError("no frame is registered: there is nothing to align")
    source, target = centers[use], true_centers[use]
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    x, y = source - source_mean, target - target_mean
    # Each camera's own rotation from the world of the estimate to that of the truth, summed.
    true_from_estimate = (true_rotations[use] @ rotations[use].transpose(0, 2, 1)).sum(axis=0)

    rank = min(_rank(x, source), _rank(y, target))
    if rank == 0:
        rotation, fitted = nearest_rotation(true_from_estimate), 1.0
    else:
        u, d, vt = np.linalg.svd(y.T @ x)
        signs = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
        rotation, fitted = (u * signs) @ vt, float(d @ signs / np.sum(x**2))
        if rank == 1:
            rotation = _rotation_about(u[:, 0], rotation, true_from_estimate) @ rotation
    scale = fitted if scale is None else scale
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def _rank(centered: Array, centers: Array) -> int:
    """0: the centres coincide, 1: they lie on a line, 2: they determine a rotation."""
    extent = np.linalg.svd(centered, compute_uv=False)
    if extent[0] <= _COINCIDENT * max(float(np.abs(centers).max()), np.finfo(np.float64).tiny):
        return 0
    return 1 if len(extent) < 2 or extent[1] <= _COLLINEAR * extent[0] else 2


def _rotation_about(axis: Array, rotation: Array, wanted: Array) -> Array:
    """The rotation about a unit axis after which `rotation` has the least chordal distance to a sum of rotations."""
    cross = cross_matrices(axis[None])[0]
    gain = rotation @ wanted.T
    along = axis @ gain @ axis
    angle = np.arctan2(np.trace(cross @ gain), np.trace(gain) - along)
    about: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return about
