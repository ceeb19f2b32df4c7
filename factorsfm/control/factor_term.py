"""Factors of the caller as a term of the polish: on its poses and affines, and on landmarks, variables of their own.

The factors are in the world of the live map. The alignment from the world of the polish to that, and the landmarks that
the factors name, are `State.control` as in `residuals`. The alignment passes through the first camera; its rotation is
free about the axes that the factors know something of, as of gravity, and its scale where they know lengths.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.state import State
from factorsfm.control.residuals import ALIGNMENT, SCALE_STD, AlignedState, ControlTerm, MarkItem, Place
from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.support.rotations import camera_centers

Array = NDArray[np.float64]

_TURN_STD = 0.05  # radians, from where on the factors know something of a turn
_HELD = 1e12  # information of what is held


class FactorTerm:
    """The factors, and the observations of their landmarks, as a term of `BundleAdjustment`.

    Args:
        factors: on all poses of the state, on the landmarks in the order of `State.control`, and on all its affines.
        marks: observations of these landmarks.
        start: (3, 3) rotation of the alignment; anchor: (3,) its place, see `AlignedState`.
        kernel: of the observations, standard deviations.

    Attributes:
        free: (7 + 3 p,) which variables are estimated; determines_scale: whether the factors know lengths.
    """

    def __init__(
        self,
        factors: FactorsOnPoses,
        marks: Sequence[MarkItem],
        start: Array,
        anchor: Array,
        kernel: float,
        state: State,
    ) -> None:
        self._factors = factors
        self._marks = ControlTerm(marks, start, anchor, np.ones(len(state.control), bool), kernel)
        self._held = np.zeros((3, 3))
        information, _ = self._quadratic(state, factors)
        first = self.aligned(state).first
        self.determines_scale = _knows_scale(information, first)
        known, axes = np.linalg.eigh(information[first : first + 3, first : first + 3])
        held = axes[:, known < _TURN_STD**-2.0]
        self._held = _HELD * held @ held.T
        self.free = np.ones(len(state.control), bool)
        self.free[:3] = held.shape[1] < 3
        self.free[3:6] = False
        self.free[6] = self.determines_scale

    def aligned(self, state: State) -> AlignedState:
        """A state with the alignment to the world of the factors."""
        return self._marks.aligned(state)

    def cost(self, state: State) -> float:
        """Cost of the factors and of the observations of their landmarks."""
        turn = state.control[:3]
        held = 0.5 * float(turn @ self._held @ turn)
        return self._factors.cost(*self._in_factors_world(state)) + self._marks.cost(state) + held

    def add(self, state: State, information: Array, gradient: Array) -> None:
        """Add to the normal equations (c, c) and (c,) of the camera side, see `Columns`."""
        mine, right = self._quadratic(state, self._factors)
        information += mine
        gradient += right
        self._marks.add(state, information, gradient)
        turn = slice(self.aligned(state).first, self.aligned(state).first + 3)
        information[turn, turn] += self._held
        gradient[turn] += self._held @ state.control[:3]

    def errors(self, state: State) -> list[tuple[str, float]]:
        """Of each factor what it is on, and its error in standard deviations."""
        return self._factors.errors(*self._in_factors_world(state))

    def agree_on_scale(self, state: State, agreeing: Sequence[int]) -> bool:
        """Whether some of the factors, by their numbers, know lengths."""
        information, _ = self._quadratic(state, self._factors.of(agreeing))
        return _knows_scale(information, self.aligned(state).first)

    def _in_factors_world(self, state: State) -> tuple[Array, Array, Array, Array]:
        """Poses (`cam_from_world`), landmarks and affines in the world of the factors."""
        world = self.aligned(state).similarity
        rotation = state.rotation @ world.rotation.T
        centers = world.points(camera_centers(state.rotation, state.translation))
        points = world.points(state.control[ALIGNMENT:].reshape(-1, 3))
        affines = np.column_stack([world.scale * state.scale, state.shift])
        return rotation, -np.einsum("kij,kj->ki", rotation, centers), points, affines

    def _quadratic(self, state: State, factors: FactorsOnPoses) -> tuple[Array, Array]:
        """Some factors alone, by the columns of the adjustment."""
        aligned, columns = self.aligned(state), Columns.of(state)
        end = 6 * len(state.rotation) + len(state.control) - ALIGNMENT  # of the poses and landmarks
        by_columns = np.zeros((end + 2 * len(state.scale), columns.size))
        for row in range(len(state.rotation)):
            used, by_variables = aligned.known_pose(row)
            by_columns[6 * row : 6 * row + 6, used] = by_variables
        for row in range((len(state.control) - ALIGNMENT) // 3):
            _, used, by_place = aligned.known_place(Place(row))
            begin = 6 * len(state.rotation) + 3 * row
            by_columns[begin : begin + 3, used] = by_place
        by_columns[np.arange(end, end + 2 * len(state.scale)), columns.affines] = np.tile(
            [aligned.scale, 1.0], len(state.scale)
        )
        by_columns[end::2, aligned.scale_column] = aligned.scale * state.scale
        information, gradient = factors.quadratic(*self._in_factors_world(state))
        return by_columns.T @ information @ by_columns, by_columns.T @ gradient


def _knows_scale(information: Array, first: int) -> bool:
    """Whether the logarithm of the scale is known, where all else is; `first`: column of the alignment."""
    return bool(1.0 / max(float(information[first + 6, first + 6]), 1e-300) < SCALE_STD**2)
