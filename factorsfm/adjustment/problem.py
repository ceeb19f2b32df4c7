"""The parts of a problem beside observations and state: free variables, prior knowledge, the model of the errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.state import State
from factorsfm.adjustment.track_errors import TrackErrors

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Free:
    """Which variables are estimated, beside the points; the shape of the lens is where it has a prior (`Known`).

    Attributes:
        cameras: False keeps everything constant but the points.
        translation: False estimates rotations and bearings alone.
        focal: whether the focal lengths are estimated.
        held: (k,) frames whose poses are constant, None: the one that is the world. Frames without observations are
            constant in any case.
    """

    cameras: bool = True
    translation: bool = True
    focal: bool = False
    held: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """The errors of the observations.

    Attributes:
        sigma: standard deviation of a coordinate (pixels).
        tracks: weights of the observations, and the correlation of their errors; the robust kernel then works on the
            depth prior alone. None: independent errors with the kernel of the options.
    """

    sigma: float
    tracks: TrackErrors | None = None


class CameraTerm(Protocol):
    """A term of the cost that does not depend on the points."""

    def cost(self, state: State) -> float: ...
    def add(self, state: State, information: Array, gradient: Array) -> None:
        """Add to the normal equations (c, c) and (c,), see `Columns`."""


class ControlTerm(CameraTerm, Protocol):
    """Known poses, points and lengths (`control.residuals`).

    Attributes:
        free: which of the variables `State.control` are estimated.
    """

    @property
    def free(self) -> NDArray[np.bool_]: ...


@dataclass(frozen=True, slots=True)
class FocalPrior:
    """Logarithms of the focal lengths: (g,) mean and (g, g) information matrix."""

    mean: Array
    information: Array

    def cost(self, state: State) -> float:
        off = state.log_focal - self.mean
        return 0.5 * float(off @ self.information @ off)

    def add(self, state: State, information: Array, gradient: Array) -> None:
        focal = Columns.of(state).log_focal
        information[focal, focal] += self.information
        gradient[focal] += self.information @ (state.log_focal - self.mean)


@dataclass(frozen=True, slots=True)
class LensPrior:
    """`State.lens`: (6,) mean and standard deviations, 0 for what is constant."""

    mean: Array
    sigmas: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """(6,) which of the variables are estimated."""
        return self.sigmas > 0

    @property
    def _information(self) -> Array:
        return np.where(self.free, self.sigmas, np.inf) ** -2.0

    def cost(self, state: State) -> float:
        return 0.5 * float((self._information * (state.lens - self.mean) ** 2).sum())

    def add(self, state: State, information: Array, gradient: Array) -> None:
        lens = Columns.of(state).lens
        np.einsum("ii->i", information)[lens] += self._information
        gradient[lens] += self._information * (state.lens - self.mean)


@dataclass(frozen=True, slots=True)
class Known:
    """Prior knowledge of focal lengths, lens and world, each None without any; the lens is constant then."""

    focal: FocalPrior | None = None
    lens: LensPrior | None = None
    control: ControlTerm | None = None

    @property
    def terms(self) -> list[CameraTerm]:
        """As terms of the cost."""
        return [term for term in (self.focal, self.lens, self.control) if term is not None]


POSES = Free()  # all but that of the world
NOTHING = Known()
