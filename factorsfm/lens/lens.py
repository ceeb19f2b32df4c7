"""A lens with unknown focal length and distortion: its values, and what an estimate of it says."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import DISTORTION, Observations
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.support.options import LensFreedom

Array = NDArray[np.float64]

READOUT_SIGMA = 1.0  # frames, of a rolling shutter of which nothing is known
_DISTORTION_SIGMA = 0.1
_CENTER_SIGMA = 0.02  # of the width


@dataclass(frozen=True, slots=True)
class Lens:
    """(g,) focal lengths (pixels), and (6,) shape as in `State.lens`."""

    focal: Array
    shape: Array = field(default_factory=lambda: np.zeros(LENS_SIZE))

    @classmethod
    def of(cls, state: State) -> Lens:
        """That of a state."""
        return cls(np.exp(state.log_focal), state.lens)

    @property
    def bends(self) -> bool:
        """Whether there is distortion or a principal point elsewhere."""
        return bool(self.shape[DISTORTION].any())


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """The estimate of an unknown lens.

    Attributes:
        lens: what the shot says, or the first guess.
        focal_std: (g,) relative standard deviations of the estimated focal lengths, believed or not; 0 of known ones.
        shape_std: (6,) standard deviations of the shape, NaN where it stays as guessed.
        misfit_px: standard deviation of the tracks where they fit no lens, so that any estimate is chance; 0 where they
            fit.
        determined: whether the focal lengths are estimates, not the guess.
        rough: whether they are not, but the shot knows more than the guess: means of both, weighted by their variances.
        zoom_std: relative standard deviation of the ratio of the longest to the shortest focal length where a zoom was
            looked for, whether one was found or not; None: none was. The course of a zoom is an estimate in any case.
        contradicted_px: the focal length of EXIF data or of a camera file that the shot contradicts; 0: none.
        announced: False of a zoom that was recognised without being asked for.
    """

    lens: Lens
    focal_std: Array
    shape_std: Array
    misfit_px: float
    determined: bool
    rough: bool = False
    zoom_std: float | None = None
    contradicted_px: float = 0.0
    announced: bool = True

    @property
    def zooms(self) -> bool:
        """Whether a zoom was found: each frame has a focal length of its own."""
        return self.zoom_std is not None and len(self.lens.focal) > 1


def shape_sigmas(freedom: LensFreedom, width: float) -> Array:
    """(4,) prior standard deviations of distortion and principal point; `width`: of what is seen, normalised."""
    distortion = 0.0 if freedom in ("auto", "fixed", "focal") else _DISTORTION_SIGMA
    center = _CENTER_SIGMA * width if freedom == "all" else 0.0
    return np.array([distortion, distortion, center, center])


def observed_width(state: State, observations: Observations) -> float:
    """Of what the tracks fill, normalised."""
    return float(np.ptp(state.normalized(observations), axis=0).max())


def through(state: State, focal: Array) -> State:
    """The state with other focal lengths (g,): points where the world's camera sees them, and as deep as they are."""
    own = state.group[state.world]
    stretch = np.exp(state.log_focal[own]) / focal[own]
    bearing = state.bearing * [stretch, stretch, 1.0]
    length = np.linalg.norm(bearing, axis=1)
    return replace(
        state,
        bearing=bearing / length[:, None],
        inverse_distance=state.inverse_distance / length,
        log_focal=np.log(focal),
    )
