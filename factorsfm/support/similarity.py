"""Similarity alignment of an estimated trajectory to the truth, over the registered frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.support.errors import InputError
from factorsfm.support.rotations import nearest_rotation

Array = NDArray[np.float64]

# Second over first singular value of the centres below which they count as a line, and extent over the
# largest coordinate below which they count as one point.
_LINE = 1e-4
_POINT = 1e-9


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
        """Points (n, 3) of the estimate in the frame of the truth."""
        return self.scale * points @ self.rotation.T + self.translation

    def rotations(self, world_from_cam: Array) -> Array:
        """Orientations (n, 3, 3) of the estimate in the frame of the truth."""
        return self.rotation @ world_from_cam


def registered_frames(centers: Array) -> NDArray[np.bool_]:
    """(n,) true where the centre (n, 3) is known: unregistered frames are NaN."""
    return np.asarray(np.isfinite(centers).all(axis=-1))


def check_trajectories(
    rotations: Array, centers: Array, true_rotations: Array, true_centers: Array
) -> tuple[Array, Array, Array, Array]:
    """The four arrays as float64, after a check of their shapes.

    Raises:
        InputError: shapes other than (n, 3, 3) and (n, 3) with one n, or truth that is not finite.
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
    """The similarity that takes estimated camera centres to the true ones with the least squared error.

    Only the centres count (Umeyama's closed form), except where they leave the rotation open: on a line
    the camera orientations decide the turn about that line, in a single point they decide all of it.
    Where the estimate or the truth does not move, the centres say nothing about the scale: it is 1.

    Args:
        rotations, true_rotations: (n, 3, 3) world_from_cam; unregistered frames NaN.
        centers, true_centers: (n, 3); unregistered frames NaN.
        scale: fixes the scale (a metric reconstruction, or one scaled by known depths); None estimates it.

    Raises:
        InputError: no frame is registered, or the arrays do not fit together.
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
    # turns[i] would make the orientation of camera i exact.
    turns = true_rotations[use] @ rotations[use].transpose(0, 2, 1)

    rank = min(_rank(x, source), _rank(y, target))
    if rank == 0:
        rotation, fitted = nearest_rotation(turns.sum(axis=0)), 1.0
    else:
        u, d, vt = np.linalg.svd(y.T @ x)
        signs = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
        rotation, fitted = (u * signs) @ vt, float(d @ signs / np.sum(x**2))
        if rank == 1:
            rotation = _turn_about(u[:, 0], rotation, turns.sum(axis=0)) @ rotation
    scale = fitted if scale is None else scale
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def _rank(centered: Array, centers: Array) -> int:
    """0: the centres coincide, 1: they lie on a line, 2: they fix a rotation."""
    extent = np.linalg.svd(centered, compute_uv=False)
    if extent[0] <= _POINT * max(float(np.abs(centers).max()), np.finfo(np.float64).tiny):
        return 0
    return 1 if len(extent) < 2 or extent[1] <= _LINE * extent[0] else 2


def _turn_about(axis: Array, rotation: Array, turns: Array) -> Array:
    """The turn about the unit axis after which `rotation` is nearest to the summed turns (chordal)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    gain = rotation @ turns.T
    along = axis @ gain @ axis
    angle = np.arctan2(np.trace(cross @ gain), np.trace(gain) - along)
    turn: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return turn
