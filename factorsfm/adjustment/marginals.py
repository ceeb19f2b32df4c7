"""Covariances of an adjustment in several gauges: relative to the first camera, or to the scene as a whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Block
from factorsfm.adjustment.state import State
from factorsfm.support.rotations import cross_matrices
from factorsfm.support.semidefinite import solution

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDING = 1e-12  # of numbers that cancel


@dataclass(frozen=True, slots=True)
class Marginals:
    """Uncertainty of a `BundleAdjustment` whose only held pose is the first.

    Attributes:
        camera: (c, c) covariance of the camera side, see `Columns`.
        point: (n, 3, 3) covariance of each point given the camera side: two tangent directions of the bearing (see
            `tangent_basis`), inverse distance.
        blocks: camera-point blocks of the information matrix with their columns and points.
    """

    camera: Array
    point: Array
    blocks: list[Block]

    def relative(self, motion: Array, measured: Array) -> Array:
        """Covariance of the camera side when the coordinates are carried along with the points.

        Args:
            motion: (c, g) movement of the camera side by each of g movements of the coordinates.
            measured: (n, 3, g) how each movement is measured, as a combination of the points' changes.
        """
        pull = np.zeros((measured.shape[2], len(self.camera)))
        weighted = self.point @ measured
        for cross, columns, points in self.blocks:
            pull[:, columns] -= (cross @ weighted[points].reshape(-1, measured.shape[2])).T
        moved = pull @ self.camera
        spread = moved @ pull.T + np.einsum("nig,nih->gh", measured, weighted)
        mixed, carried = motion @ moved, motion @ spread @ motion.T
        relative = self.camera - mixed - mixed.T + carried
        # Where movements of the coordinates are hardly determined, large numbers cancel: what rounding leaves is as
        # uncertain as it is wrong.
        cancelled = self.camera.diagonal() + 2.0 * np.abs(mixed.diagonal()) + carried.diagonal()
        relative[np.diag_indices_from(relative)] += _ROUNDING * cancelled
        return np.asarray(relative)

    def inverse_distances(self, points: Index) -> Array:
        """(p, p) joint covariance of the inverse distances of some points."""
        gain = np.zeros((len(points), len(self.camera)))
        for cross, columns, members in self.blocks:
            inside = np.flatnonzero(np.isin(points, members))
            local = np.searchsorted(members, points[inside])
            picked = cross.reshape(len(columns), -1, 3)[:, local]
            gain[np.ix_(inside, columns)] = np.einsum("cpi,pi->pc", picked, self.point[points[inside], 2])
        joint = gain @ self.camera @ gain.T
        joint[np.diag_indices_from(joint)] += self.point[points, 2, 2]
        return np.asarray(joint)

    def inverse_distance_std(self, camera: Array) -> Array:
        """(n,) standard deviations of the inverse distances.

        Args:
            camera: (c, c) covariance of the camera side, as it is or as `relative` gives it.
        """
        variance = self.point[:, 2, 2].copy()
        for cross, columns, points in self.blocks:
            gain = np.einsum("cni,ni->nc", cross.reshape(len(columns), -1, 3), self.point[points, 2])
            variance[points] += np.einsum("nc,nc->n", gain @ camera[np.ix_(columns, columns)], gain)
        return np.sqrt(np.maximum(variance, 0.0))


def in_scene_unit(marginals: Marginals, state: State, control: Array | None = None) -> Array:
    """Covariance of the camera side relative to the first camera, in the scene's unit of length.

    Only weak priors determine the unit. Here it is the mean inverse distance of the points: the errors are those that
    remain when a solution is scaled to the true mean.

    Args:
        control: by how much `State.control` changes with the logarithm of the scene's size; None without control.
    """
    measured = np.zeros((len(state.bearing), 3, 1))
    measured[:, 2] = 1.0 / state.inverse_distance.sum()
    return marginals.relative(unit_motion(state, control)[:, None], measured)


def unit_motion(state: State, control: Array | None = None) -> Array:
    """(c,) movement of the camera side by the logarithm of the mean inverse distance; `control` as `in_scene_unit`."""
    columns = Columns.of(state)
    motion = np.zeros(columns.size)
    motion[columns.poses].reshape(-1, 6)[:, 3:] = state.translation
    motion[columns.scales] = -state.scale
    motion[columns.field] = state.field
    if control is not None:
        motion[columns.control] = control
    return motion


def pose_covariances(camera: Array, derivative: Array, columns: Index, state: State) -> tuple[Array, Array]:
    """(k, 6, 6) of the poses, and (k, 6, 6) of each pose relative to the one before, that of the first zero.

    A relative pose ``previous_from_this`` is perturbed on the right like `world_from_cam`; it moves by the perturbation
    of this pose less that of the previous one, which the adjoint map of ``this_from_previous`` carries over.

    Args:
        camera: (c, c) covariance of the camera side.
        derivative: (k, 6, d) of the perturbation of each pose by some columns; columns: (k, d) which.
    """
    own = derivative @ camera[columns[:, :, None], columns[:, None]] @ derivative.transpose(0, 2, 1)
    turn = state.rotation[1:] @ state.rotation[:-1].transpose(0, 2, 1)
    shift = state.translation[1:] - np.einsum("kij,kj->ki", turn, state.translation[:-1])
    adjoint = np.zeros((len(turn), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = turn
    adjoint[:, 3:, :3] = cross_matrices(shift) @ turn
    both = np.concatenate([derivative[1:], -adjoint @ derivative[:-1]], 2)
    used = np.concatenate([columns[1:], columns[:-1]], 1)
    relative = both @ camera[used[:, :, None], used[:, None]] @ both.transpose(0, 2, 1)
    return np.asarray(own), np.concatenate([np.zeros((1, 6, 6)), relative])


def scene_weights(marginals: Marginals, state: State) -> Array:
    """(n,) how much each point counts in the place of the scene: less if it is far away or badly determined."""
    w, variance = state.inverse_distance, marginals.point[:, 2, 2]
    far = np.median(w) ** 2 / np.maximum(w, 1e-9) ** 2
    return np.asarray(np.sqrt(np.median(variance) / np.maximum(variance, np.median(variance))) / (1.0 + far))


def in_scene(marginals: Marginals, state: State, weights: Array) -> Array:
    """(6 k, 6 k) covariance of the poses relative to the scene as a whole.

    The coordinates (position, orientation, unit of length) are those in which the points are where they should be in
    the least-squares sense, with `weights` (n,) on their distances.
    """
    frames, points, w = len(state.rotation), state.points, np.maximum(state.inverse_distance, 1e-9)
    moved = np.concatenate([np.tile(np.eye(3), (len(w), 1, 1)), -cross_matrices(points), points[:, :, None]], 2)
    by_point = np.concatenate(
        [tangent_basis(state.bearing) / w[:, None, None], -(state.bearing / w[:, None] ** 2)[:, :, None]], 2
    )
    weighted = weights[:, None, None] ** 2 * moved
    normal = np.einsum("nig,nih->gh", weighted, moved)
    by_normal = solution(normal, np.eye(7))  # of few points, some movements of the coordinates are none of them
    measured = np.einsum("nij,nig->njg", by_point, weighted) @ by_normal
    centers = -np.einsum("kji,kj->ki", state.rotation, state.translation)
    poses = Columns.of(state).poses
    motion = np.zeros((len(marginals.camera), 7))
    pose = motion[poses].reshape(frames, 6, 7)
    pose[:, :3, 3:6] = state.rotation
    pose[:, 3:, :3] = state.rotation
    pose[:, 3:, 3:6] = -state.rotation @ cross_matrices(centers)
    pose[:, 3:, 6] = -state.translation
    return marginals.relative(motion, measured)[poses, poses]


def tangent_basis(bearing: Array) -> Array:
    """(n, 3, 2) orthonormal basis of the plane perpendicular to each unit vector."""
    x, y, z = bearing.T
    upright = np.abs(x) < 0.7  # the cross product by the x axis, or by the y axis
    a, b, c = np.where(upright, 0.0, -z), np.where(upright, z, 0.0), np.where(upright, -y, x)
    length = np.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
    return np.stack([a, y * c - z * b, b, z * a - x * c, c, x * b - y * a], -1).reshape(-1, 3, 2)
