"""Factors of the caller as a quadratic on poses, landmarks and affines: their own variables are eliminated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from itertools import accumulate

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, X
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors, MapValues, error_of, held_prior, present_values
from factorsfm.graph.factors import HELD, NATIVE_BY_AFFINE, native_affine, pose_from_camera
from factorsfm.graph.keys import keys_of, letter_of, name_of, ordering_of, part_of

Array = NDArray[np.float64]

_STEPS = 4  # to the best values of the caller's variables, from the last ones
_WEAK = 1e-9  # information of what nothing determines


class FactorsOnPoses:
    """Factors as a function of some poses, landmarks and affines; all else that they name follows.

    Args:
        added: the factors; contents: of the map, where the variables begin that are not among these.
        frames, tracks, guided: the poses, the landmarks, and the frames of the affines, in the order of the columns.

    Attributes:
        loose: names of affines that follow although they are the map's: nothing else says of them what they are.
    """

    def __init__(
        self,
        added: AddedFactors,
        contents: MapValues,
        frames: Sequence[int],
        tracks: Sequence[int],
        guided: Sequence[int] = (),
    ) -> None:
        self._graph, self._own = added.graph(), added.values()
        self._keys = [*map(X, frames), *map(L, tracks), *map(A, guided)]
        named = keys_of(self._graph)
        following = added.named - set(self._keys)
        self.loose = [name_of(key) for key in sorted(following) if letter_of(key) == "a"]
        self._own.insert(present_values(following, contents))
        self._named = [row for row, key in enumerate(self._keys) if key in named]
        by_native = [np.eye(6)] * len(frames) + [np.eye(3)] * len(tracks) + [NATIVE_BY_AFFINE] * len(guided)
        ends = list(accumulate(block.shape[1] for block in by_native))
        self._size = ends[-1]
        self._columns = [np.arange(end - block.shape[1], end) for end, block in zip(ends, by_native, strict=True)]
        self._by_native = by_native  # derivatives of GTSAM's variables by the columns

    def of(self, rows: Sequence[int]) -> FactorsOnPoses:
        """Some of the factors, as a function of the same."""
        part, part._graph = copy(self), gtsam.NonlinearFactorGraph()
        for row in rows:
            part._graph.add(self._graph.at(row))
        return part

    def cost(self, rotation: Array, translation: Array, points: Array, affines: Array) -> float:
        """The least cost, with the best values of all other variables.

        Args:
            rotation (n, 3, 3), translation (n, 3): `cam_from_world`; points: (p, 3) landmarks; affines: (a, 2) scale
                and shift.
        """
        return float(self._graph.error(self._best(self._at(rotation, translation, points, affines))))

    def quadratic(self, rotation: Array, translation: Array, points: Array, affines: Array) -> tuple[Array, Array]:
        """Information (d, d) and gradient (d,) of that cost, d = 6 n + 3 p + 2 a.

        Poses are perturbed as in `factors`.
        """
        values = self._best(self._at(rotation, translation, points, affines))
        linear = self._graph.linearize(values)
        others = self._own.dims()
        for key, size in others.items():
            linear.add(key, np.sqrt(_WEAK) * np.eye(size), np.zeros(size), gtsam.noiseModel.Unit.Create(size))
        if others:
            linear = linear.eliminatePartialMultifrontal(ordering_of(others))[1]
        information, gradient = np.zeros((self._size, self._size)), np.zeros(self._size)
        left = set(linear.keyVector())
        mine = [row for row in self._named if self._keys[row] in left]
        if mine:
            hessian, right = linear.hessian(ordering_of(self._keys[row] for row in mine))
            ends = list(accumulate(len(self._by_native[row]) for row in mine))
            by_columns = np.zeros((ends[-1], self._size))
            for row, end in zip(mine, ends, strict=True):
                block = self._by_native[row]
                by_columns[end - len(block) : end, self._columns[row]] = block
            information += by_columns.T @ hessian @ by_columns
            gradient -= by_columns.T @ np.asarray(right).ravel()
        return information, gradient

    def errors(self, rotation: Array, translation: Array, points: Array, affines: Array) -> list[tuple[str, float]]:
        """Of each factor what it is on, and its error in standard deviations, the root mean square of its rows."""
        values = self._best(self._at(rotation, translation, points, affines))
        factors = [self._graph.at(k) for k in range(self._graph.size())]
        return [
            (f"{type(factor).__name__} on {', '.join(map(name_of, factor.keys()))}", error_of(factor, values))
            for factor in factors
        ]

    def with_poses(
        self, poses: Mapping[int, tuple[tuple[Array, Array], Array | None]]
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The factors with priors of the poses that they name, and values of all variables; a copy.

        Args:
            poses: `cam_from_world` and covariance (6, 6) by frame.
        """
        graph, values = gtsam.NonlinearFactorGraph(self._graph), gtsam.Values(self._own)
        named = {self._keys[row] for row in self._named}
        for frame, (camera, covariance) in poses.items():
            if (key := X(frame)) in named:
                spread = (0.0 if covariance is None else covariance) + HELD**2 * np.eye(6)
                values.insert_or_assign(key, pose_from_camera(*camera))
                graph.add(
                    gtsam.PriorFactorPose3(key, values.atPose3(key), gtsam.noiseModel.Gaussian.Covariance(spread))
                )
        return graph, values

    def _at(self, rotation: Array, translation: Array, points: Array, affines: Array) -> gtsam.Values:
        values = gtsam.Values()
        places, pairs = len(rotation), len(rotation) + len(points)
        for row in self._named:
            if row < places:
                values.insert(self._keys[row], pose_from_camera(rotation[row], translation[row]))
            elif row < pairs:
                values.insert(self._keys[row], points[row - places])
            else:
                values.insert(self._keys[row], native_affine(*affines[row - pairs].tolist()))
        return values

    def _best(self, fixed: gtsam.Values) -> gtsam.Values:
        """With the best values of all other variables (Levenberg-Marquardt); they are where the next search begins."""
        values = gtsam.Values(fixed)
        values.insert(self._own)
        if not self._own.size():
            return values
        graph = gtsam.NonlinearFactorGraph(self._graph)
        for key in list(fixed.keys()):
            graph.add(held_prior(key, fixed))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(_STEPS)
        found = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        self._own = part_of(found, list(self._own.keys()))
        values = gtsam.Values(fixed)
        values.insert(self._own)
        return values
