"""The variables of an adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import READOUT, Observations
from factorsfm.adjustment.residuals import camera_points, undistort

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LENS_SIZE = 6  # of `State.lens`, and its parts: distortion with principal point, readout


@dataclass(slots=True)
class State:
    """All variables.

    Attributes:
        rotation (k, 3, 3), translation (k, 3): `cam_from_world`.
        world: the frame whose camera is the world, -1 for none.
        bearing (n, 3) unit, inverse_distance (n,): points seen from the world's origin.
        log_focal: (g,) logarithms of the focal lengths in pixels.
        lens: (6,) distortion and principal point as in `residuals.distort`, and the readout of a rolling shutter along
            columns and rows, see `Sweep`; zero where the observations are undistorted already.
        group: (k,) which of the focal lengths is that of each frame; by default all have the first.
        scale, shift: (images,) affine of each image with a prior.
        control: world alignment and marked points, see `control.residuals`; empty without control.
        field: (nodes,) smooth error of the prior in units of inverse depth, shared by all its images.
    """

    rotation: Array
    translation: Array
    bearing: Array
    inverse_distance: Array
    log_focal: Array
    lens: Array = field(default_factory=lambda: np.zeros(LENS_SIZE))
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

    def in_frames(self, frames: Index) -> State:
        """The same with some of the frames (ascending), that of the world among them."""
        return replace(
            self,
            rotation=self.rotation[frames],
            translation=self.translation[frames],
            group=self.group[frames],
            world=int(np.searchsorted(frames, self.world)),
        )

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
        """(m, 3) homogeneous camera-frame vectors `q` of `residuals.camera_points`."""
        return camera_points(
            self.rotation[frame], self.translation[frame], self.bearing[point], self.inverse_distance[point]
        )

    def normalized(self, observations: Observations) -> Array:
        """(m, 2) undistorted normalised coordinates of what the lens shows; NaN where it has no ray for a pixel."""
        o = observations
        distorted = (o.pixels - o.swept(self.lens[READOUT])) / self.focal[o.frame, None]
        return undistort(distorted, self.lens)
