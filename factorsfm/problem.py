"""The polish in data: what is measured, and the variables that explain it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.factors import camera_points

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Observations:
    """m observations of n points in k frames, sorted by point.

    Attributes:
        frame, point: (m,) indices.
        xy: (m, 2) undistorted normalised image coordinates.
    """

    frame: Index
    point: Index
    xy: Array

    @property
    def first(self) -> Index:
        """(n,) row of the first observation of each point."""
        return np.searchsorted(self.point, np.arange(self.point[-1] + 1 if len(self.point) else 0))

    def mean_by_point(self, values: Array) -> Array:
        """(n,) mean over the observations of each point of something that each has, (m,)."""
        first = self.first
        return np.asarray(np.add.reduceat(values, first) / np.diff(np.append(first, len(values))))

    def of(self, points: Index) -> Observations:
        """Those of some points (ascending), renumbered."""
        keep = np.isin(self.point, points)
        return Observations(self.frame[keep], np.searchsorted(points, self.point[keep]), self.xy[keep])


@dataclass(frozen=True, slots=True)
class PriorObservations:
    """Values of the depth prior at observations, sorted by point.

    Attributes:
        image: (m,) which affine; frame, point: (m,) as in `Observations`.
        inverse_depth: (m,) values of the prior's maps.
        sigma: (m,) standard deviation of the independent part of the error.
        nodes, node_weights: (m, 4) nodes of the smooth error field around each point and their weights.
        field_information: (nodes, nodes) inverse covariance of the field.
        scale_sigma, shift_sigma: priors of each affine around 1 and 0 (scale: of the logarithm).
    """

    image: Index
    frame: Index
    point: Index
    inverse_depth: Array
    sigma: Array
    nodes: Index
    node_weights: Array
    field_information: Array
    scale_sigma: float
    shift_sigma: float


@dataclass(slots=True)
class State:
    """All variables.

    Attributes:
        rotation (k, 3, 3), translation (k, 3): `cam_from_world`.
        world: the frame whose camera is the world.
        bearing (n, 3) unit, inverse_distance (n,): points seen from the world's origin.
        log_focal: (g,) logarithms of the focal lengths in pixels.
        lens: (4,) distortion and principal point as in `factors.distort`, where they are estimated.
        group: (k,) which of the focal lengths is that of each frame; by default all have the first.
        scale, shift: (images,) affine of each image with a prior.
        control: datum and marked points, see `control_term`; empty without control.
        field: (nodes,) smooth error of the prior in units of inverse depth, shared by all its images.
    """

    rotation: Array
    translation: Array
    bearing: Array
    inverse_distance: Array
    log_focal: Array
    lens: Array = field(default_factory=lambda: np.zeros(4))
    group: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    scale: Array = field(default_factory=lambda: np.zeros(0))
    shift: Array = field(default_factory=lambda: np.zeros(0))
    control: Array = field(default_factory=lambda: np.zeros(0))
    field: Array = field(default_factory=lambda: np.zeros(0))
    world: int = 0

    def __post_init__(self) -> None:
        if not len(self.group):
            self.group = np.zeros(len(self.rotation), np.int64)

    @property
    def focal(self) -> Array:
        """(k,) focal length of each frame, pixels."""
        return np.asarray(np.exp(self.log_focal)[self.group])

    @property
    def points(self) -> Array:
        """(n, 3) Euclidean points; those at infinity end up very far away."""
        return self.bearing / np.maximum(self.inverse_distance, 1e-9)[:, None]

    def of(self, points: Index) -> State:
        """The same with some of the points, as `Observations.of` numbers them."""
        return replace(self, bearing=self.bearing[points], inverse_distance=self.inverse_distance[points])

    def seen_from(self, frame: int) -> State:
        """The same with another camera as the world."""
        if frame == self.world:
            return self
        turn, shift = self.rotation[frame], self.translation[frame]
        rotation = self.rotation @ turn.T
        bearing = self.bearing @ turn.T + self.inverse_distance[:, None] * shift
        length = np.linalg.norm(bearing, axis=1)
        return replace(
            self,
            rotation=rotation,
            translation=self.translation - rotation @ shift,
            bearing=bearing / length[:, None],
            inverse_distance=self.inverse_distance / length,
            world=frame,
        )

    def camera_points(self, frame: Index, point: Index) -> Array:
        """(m, 3) homogeneous camera-frame vectors `q` of `factors.camera_points`."""
        return camera_points(
            self.rotation[frame], self.translation[frame], self.bearing[point], self.inverse_distance[point]
        )
