"""What factors of the caller say of poses and landmarks, as a quadratic: their own variables are eliminated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors, MapValues, error_of, held_prior, present_values
from factorsfm.graph.factors import HELD, pose_from_camera
from factorsfm.graph.keys import keys_of, name_of, ordering_of, part_of

Array = NDArray[np.float64]

_STEPS = 4  # to the best values of the caller's variables, from the last ones
_WEAK = 1e-9  # information of what nothing determines


class FactorsOnPoses:
    """Factors as a function of some poses and landmarks; all else that they name follows.

    Args:
        added: the factors; contents: of the map, where the variables begin that are not among the poses and landmarks.
        frames, tracks: the poses and landmarks, in the order of the rows and columns.
    """

    def __init__(self, added: AddedFactors, contents: MapValues, frames: Sequence[int], tracks: Sequence[int]) -> None:
        self._graph, self._own = added.graph(), added.values()
        self._keys = [*map(X, frames), *map(L, tracks)]
        named = keys_of(self._graph)
        self._own.insert(present_values(added.named - set(self._keys), contents))
        self._named = [row for row, key in enumerate(self._keys) if key in named]
        ends = np.cumsum([6 if row < len(frames) else 3 for row in range(len(self._keys))])
        self._columns = np.split(np.arange(ends[-1]), ends[:-1])

    def cost(self, rotation: Array, translation: Array, points: Array) -> float:
        """The least cost, with the best values of all other variables.

        Args:
            rotation (n, 3, 3), translation (n, 3): `cam_from_world`; points: (p, 3) landmarks.
        """
        return float(self._graph.error(self._best(self._at(rotation, translation, points))))

    def quadratic(self, rotation: Array, translation: Array, points: Array) -> tuple[Array, Array]:
        """Information (d, d) and gradient (d,) of that cost, d = 6 n + 3 p; poses are perturbed as in `factors`."""
        values = self._best(self._at(rotation, translation, points))
        linear = self._graph.linearize(values)
        others = self._own.dims()
        for key, size in others.items():
            linear.add(key, np.sqrt(_WEAK) * np.eye(size), np.zeros(size), gtsam.noiseModel.Unit.Create(size))
        if others:
            linear = linear.eliminatePartialMultifrontal(ordering_of(others))[1]
        size = int(self._columns[-1][-1]) + 1
        information, gradient = np.zeros((size, size)), np.zeros(size)
        left = set(linear.keyVector())
        mine = [row for row in self._named if self._keys[row] in left]
        if mine:
            columns = np.concatenate([self._columns[row] for row in mine])
            hessian, right = linear.hessian(ordering_of(self._keys[row] for row in mine))
            information[np.ix_(columns, columns)] = hessian
            gradient[columns] = -np.asarray(right).ravel()
        return information, gradient

    def errors(self, rotation: Array, translation: Array, points: Array) -> list[tuple[str, float]]:
        """Of each factor what it is on, and its error in standard deviations, the root mean square of its rows."""
        values = self._best(self._at(rotation, translation, points))
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

    def _at(self, rotation: Array, translation: Array, points: Array) -> gtsam.Values:
        values = gtsam.Values()
        for row in self._named:
            if row < len(rotation):
                values.insert(self._keys[row], pose_from_camera(rotation[row], translation[row]))
            else:
                values.insert(self._keys[row], points[row - len(rotation)])
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
