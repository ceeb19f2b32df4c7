"""What is measured: observations of tracks, how they move during the readout, and values of the depth prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

DISTORTION, READOUT = slice(0, 4), slice(4, 6)


@dataclass(frozen=True, slots=True)
class Sweep:
    """How m observations move in the image while it is read out, see `rolling_shutter`.

    Attributes:
        motion, acceleration: (m, 2) when it is read, pixels per frame, and per frame squared.
        place: (m, 2) columns and rows from the principal point, in widths and heights of the image: an observation is
            read at the time ``place @ readout``, in frames, from that of its pose.
    """

    motion: Array
    acceleration: Array
    place: Array

    def of(self, rows: NDArray[np.bool_] | Index) -> Sweep:
        """That of some of the observations."""
        return Sweep(self.motion[rows], self.acceleration[rows], self.place[rows])

    def displacement(self, readout: Array) -> Array:
        """(m, 2) pixels, for a readout (2,) along columns and rows."""
        time = (self.place @ readout)[:, None]
        return np.asarray(time * (self.motion - 0.5 * time * self.acceleration))

    def by_readout(self, readout: Array) -> Array:
        """(m, 2, 2) derivative of the displacement."""
        velocity = self.motion - (self.place @ readout)[:, None] * self.acceleration
        return np.asarray(velocity[:, :, None] * self.place[:, None, :])


@dataclass(frozen=True, slots=True)
class Observations:
    """m observations of n points in k frames, sorted by point.

    Attributes:
        frame, point: (m,) indices.
        pixels: (m, 2) relative to the principal point, before anything that `State.lens` models is taken away.
        sweep: how each moves while the image is read out; None where that is not known.
    """

    frame: Index
    point: Index
    pixels: Array
    sweep: Sweep | None = None

    @property
    def first(self) -> Index:
        """(n,) row of the first observation of each point."""
        return np.searchsorted(self.point, np.arange(self.point[-1] + 1 if len(self.point) else 0))

    def rows_by_frame(self, frames: int) -> list[Index]:
        """Rows (ascending) of each of so many frames."""
        order = np.argsort(self.frame, kind="stable")
        return np.split(order, np.searchsorted(self.frame[order], np.arange(1, frames)))

    def mean_by_point(self, values: Array) -> Array:
        """(n,) mean over the observations of each point of something that each has, (m,)."""
        first = self.first
        return np.asarray(np.add.reduceat(values, first) / np.diff(np.append(first, len(values))))

    def of(self, points: Index) -> Observations:
        """Those of some points (ascending), renumbered."""
        rows = np.isin(self.point, points)
        return self.at(rows, point=np.searchsorted(points, self.point[rows]))

    def at(
        self, rows: NDArray[np.bool_] | Index, *, frame: Index | None = None, point: Index | None = None
    ) -> Observations:
        """Some of them, or all in another order, where asked for with other indices."""
        return Observations(
            self.frame[rows] if frame is None else frame,
            self.point[rows] if point is None else point,
            self.pixels[rows],
            None if self.sweep is None else self.sweep.of(rows),
        )

    def swept(self, readout: Array) -> Array:
        """(m, 2) by how far each has moved when it is read out (pixels); `readout`: as in `State.lens`."""
        if self.sweep is None or not readout.any():
            return np.zeros((1, 2))
        return self.sweep.displacement(readout)


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
