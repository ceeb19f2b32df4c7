"""Control as a term of the polish: its residuals with their derivatives, by poses, marked points and world alignment.

The polish stays in the world of its first camera. The world alignment takes a position ``x`` of that to the world of
the control, ``y = s R (x - a) + T``. Its seven variables and the positions of the marked points are `State.control` and
the last columns of the camera side: a rotation vector (applied after the start of R), T, log s, then three for each
point.

Every residual is in standard deviations. Pose derivatives use the convention of `adjustment.residuals`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.observations import DISTORTION
from factorsfm.adjustment.residuals import by_pose, camera_points, cauchy, reprojection
from factorsfm.adjustment.state import State
from factorsfm.support.rotations import cross_matrices
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ALIGNMENT = 7  # variables of the world alignment
SCALE_STD = 0.3  # of the logarithm of the scale, with which it counts as known

# Residual (d,), the columns that it depends on (c,), and its derivative by these (d, c).
Linearized = tuple[Array, Index, Array]


@dataclass(frozen=True, slots=True)
class Place:
    """A camera (row of the frame), or a marked point (row of the point)."""

    row: int
    camera: bool = False


class AlignedState:
    """A state with its alignment to the world of the control.

    Args:
        start: (3, 3) rotation of the alignment before `State.control` turns it; anchor: (3,) the position ``a``.
    """

    def __init__(self, state: State, start: Array, anchor: Array) -> None:
        self.state, self.columns = state, Columns.of(state)
        self.first = int(self.columns.control.start)  # column of the first variable of the alignment
        turn, by_vector = cv2.Rodrigues(state.control[:3])
        self.rotation = turn @ start
        self.by_vector = np.asarray(by_vector).reshape(3, 3, 3) @ start  # of the rotation, by the rotation vector
        self.shift, self.scale = state.control[3:6], float(np.exp(state.control[6]))
        self.anchor = anchor

    @property
    def similarity(self) -> Similarity:
        """From the world of the polish to that of the control."""
        return Similarity(self.scale, self.rotation, self.shift - self.scale * self.rotation @ self.anchor)

    def place(self, place: Place) -> Linearized:
        """Position in the world of the polish."""
        if place.camera:
            rotation, translation = self.state.rotation[place.row], self.state.translation[place.row]
            return -rotation.T @ translation, self.columns.pose(place.row)[3:], rotation.T
        offset = ALIGNMENT + 3 * place.row
        return self.state.control[offset : offset + 3], self.first + offset + np.arange(3), np.eye(3)

    def known_place(self, place: Place) -> Linearized:
        """Position in the world of the control, by the place and by the alignment."""
        x, columns, by_place = self.place(place)
        away = self.rotation @ (x - self.anchor)
        by_turn = self.scale * (self.by_vector @ (x - self.anchor)).T
        by_alignment = np.concatenate([by_turn, np.eye(3), self.scale * away[:, None]], 1)
        derivative = np.concatenate([self.scale * self.rotation @ by_place, by_alignment], 1)
        return self.scale * away + self.shift, np.append(columns, self.first + np.arange(ALIGNMENT)), derivative

    def known_pose(self, row: int) -> tuple[Index, Array]:
        """(13,) columns that a camera in the world of the control depends on, and the derivative (6, 13) by them.

        Of its perturbation on the right as seen from the camera, in the control's unit of length.
        """
        _, _, by_place = self.known_place(Place(row, camera=True))
        rotation, derivative = self.state.rotation[row], np.zeros((6, 6 + ALIGNMENT))
        derivative[:, :6] = np.diag(np.repeat([1.0, self.scale], 3))
        derivative[:3, 6:9] = rotation @ self.own_turn
        derivative[3:, 6:] = rotation @ self.rotation.T @ by_place[:, 3:]
        return np.append(self.columns.pose(row), self.first + np.arange(ALIGNMENT)), derivative

    @property
    def own_turn(self) -> Array:
        """(3, 3) small rotation of the alignment on its right, as of a pose, by its rotation vector."""
        skew = self.rotation.T @ self.by_vector
        return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])

    @property
    def scale_column(self) -> int:
        return self.first + 6


class Item(Protocol):
    """A known value, as a residual.

    Attributes:
        name: for people; unit: of its error ("m", "degrees", "px"), `sigma` in the same unit.
    """

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def sigma(self) -> float: ...
    def linearized(self, aligned: AlignedState) -> Linearized: ...


@dataclass(frozen=True, slots=True)
class PositionItem:
    """``(y - known) / sigma`` of a camera or a marked point."""

    name: str
    place: Place
    known: Array
    sigma: float
    unit: str = "m"

    def linearized(self, aligned: AlignedState) -> Linearized:
        y, columns, derivative = aligned.known_place(self.place)
        return (y - self.known) / self.sigma, columns, derivative / self.sigma


@dataclass(frozen=True, slots=True)
class RotationItem:
    """Rotation vector of ``G W`` over sigma: G the known cam_from_world, W the camera's world_from_cam beside it."""

    name: str
    row: int
    known: Array
    sigma: float  # degrees
    unit: str = "degrees"

    def linearized(self, aligned: AlignedState) -> Linearized:
        world_from_cam = aligned.state.rotation[self.row].T
        off = self.known @ aligned.rotation @ world_from_cam
        vector = cv2.Rodrigues(off)[0][:, 0]
        by_camera = np.concatenate([np.eye(3), aligned.state.rotation[self.row] @ aligned.own_turn], 1)
        derivative = _inverse_right_jacobian(vector) @ by_camera
        columns = np.append(aligned.columns.pose(self.row)[:3], aligned.first + np.arange(3))
        sigma = np.radians(self.sigma)
        return vector / sigma, columns, derivative / sigma


@dataclass(frozen=True, slots=True)
class MarkItem:
    """The residual `reprojection` of a marked point in a frame, over sigma."""

    name: str
    row: int
    point: Place
    observed: Array  # (2,) pixels, as in `Observations`
    sigma: float  # pixels
    unit: str = "px"

    def linearized(self, aligned: AlignedState) -> Linearized:
        s, focal, one = aligned.state, float(aligned.state.focal[self.row]), np.ones(1)
        x, columns, _ = aligned.place(self.point)
        q = camera_points(s.rotation[self.row], s.translation[self.row], x[None], one)
        q[:, 2] = np.maximum(q[:, 2], 1e-6)
        residual, by_q = reprojection(q, self.observed[None], focal, s.lens if s.lens[DISTORTION].any() else None)
        by_camera = by_pose(by_q[0], q.repeat(2, 0), one.repeat(2))
        derivative = np.concatenate([by_camera, by_q[0] @ s.rotation[self.row]], 1)
        return residual[0] / self.sigma, np.append(aligned.columns.pose(self.row), columns), derivative / self.sigma


@dataclass(frozen=True, slots=True)
class DistanceItem:
    """``(s |x_1 - x_2| - known) / sigma`` between two places."""

    name: str
    ends: tuple[Place, Place]
    known: float
    sigma: float
    unit: str = "m"

    def linearized(self, aligned: AlignedState) -> Linearized:
        (a, a_columns, by_a), (b, b_columns, by_b) = (aligned.place(end) for end in self.ends)
        length = float(np.linalg.norm(a - b))
        along = aligned.scale * (a - b) / max(length, 1e-12)
        derivative = np.concatenate([along @ by_a, -along @ by_b, [aligned.scale * length]])[None]
        columns = np.concatenate([a_columns, b_columns, [aligned.scale_column]])
        return np.array([aligned.scale * length - self.known]) / self.sigma, columns, derivative / self.sigma


@dataclass(frozen=True, slots=True)
class HeightItem:
    """``(s |n (c - x)| - known) / sigma`` of a camera c above the plane with the unit normal n through three points."""

    name: str
    row: int
    points: tuple[Place, Place, Place]
    known: float
    sigma: float
    unit: str = "m"

    def linearized(self, aligned: AlignedState) -> Linearized:
        center, columns, by_center = aligned.place(Place(self.row, camera=True))
        base, first, second = (aligned.place(point)[0] for point in self.points)
        a, b, e = first - base, second - base, center - base
        normal = np.cross(a, b)
        size = max(float(np.linalg.norm(normal)), 1e-12)
        normal = normal / size
        height = float(normal @ e)
        side = aligned.scale * (1.0 if height >= 0.0 else -1.0)
        beside = (e - height * normal) / size
        by_e, by_a, by_b = side * normal, side * np.cross(b, beside), side * np.cross(beside, a)
        derivative = np.concatenate([by_e @ by_center, -(by_a + by_b + by_e), by_a, by_b, [side * height]])[None]
        columns = np.concatenate([columns, *(aligned.place(point)[1] for point in self.points), [aligned.scale_column]])
        return np.array([side * height - self.known]) / self.sigma, columns, derivative / self.sigma


class ControlTerm:
    """All control as a term of `BundleAdjustment`, with a Cauchy kernel on every item.

    Args:
        start: (3, 3) rotation of the alignment; anchor: (3,) its place in the world of the polish, see `AlignedState`.
        free: (7 + 3 p,) which variables of the alignment and of the marked points are estimated.
        kernel: scale of the Cauchy kernel, standard deviations.
    """

    def __init__(
        self,
        items: Sequence[Item],
        start: Array,
        anchor: Array,
        free: NDArray[np.bool_],
        kernel: float,
    ) -> None:
        self.items, self.kernel = items, kernel
        self.free = free
        self._start, self._anchor = start, anchor

    def aligned(self, state: State) -> AlignedState:
        """A state with the alignment of this control."""
        return AlignedState(state, self._start, self._anchor)

    def residuals(self, state: State) -> list[Array]:
        """Of every item, in standard deviations."""
        aligned = self.aligned(state)
        return [item.linearized(aligned)[0] for item in self.items]

    def knows_scale(self, state: State, items: Sequence[Item]) -> bool:
        """Whether some of the items determine the scale, where the scene is as it is in its own unit.

        It is known, too, where held poses do not leave it free.
        """
        if not self.free[6]:
            return True
        aligned = self.aligned(state)
        information = np.zeros((ALIGNMENT, ALIGNMENT))
        for item in items:
            _, columns, derivative = item.linearized(aligned)
            mine = columns >= aligned.first
            by_alignment = np.zeros((len(derivative), len(state.control)))
            by_alignment[:, columns[mine] - aligned.first] = derivative[:, mine]
            information += by_alignment[:, :ALIGNMENT].T @ by_alignment[:, :ALIGNMENT]
        others = np.flatnonzero(self.free[: ALIGNMENT - 1])
        shared = information[others, -1]
        alone = information[-1, -1] - shared @ np.linalg.pinv(information[np.ix_(others, others)], 1e-9) @ shared
        return bool(alone * SCALE_STD**2 > 1.0)

    def cost(self, state: State) -> float:
        """Robust cost."""
        return sum(float(cauchy(r[None], self.kernel)[0][0]) for r in self.residuals(state))

    def add(self, state: State, information: Array, gradient: Array) -> None:
        """Add to the normal equations (c, c) and (c,) of the camera side, see `Columns`."""
        aligned = self.aligned(state)
        for item in self.items:
            residual, columns, derivative = item.linearized(aligned)
            weight = cauchy(residual[None], self.kernel)[1][0]
            information[np.ix_(columns, columns)] += weight * derivative.T @ derivative
            gradient[columns] += weight * derivative.T @ residual


def _inverse_right_jacobian(vector: Array) -> Array:
    """(3, 3) change of a rotation vector by a small rotation on the right (Forster et al., T-RO 2017, equation 9)."""
    angle = float(np.linalg.norm(vector))
    hat = cross_matrices(vector[None])[0]
    bend = 1.0 / 12.0 if angle < 1e-3 else 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) + 0.5 * hat + bend * hat @ hat)
