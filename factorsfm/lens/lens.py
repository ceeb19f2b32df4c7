"""A lens with unknown focal length and distortion, and what is seen through another one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.observations import DISTORTION, READOUT, Observations
from factorsfm.adjustment.residuals import distort
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.support.options import LensFreedom

Array = NDArray[np.float64]
Index = NDArray[np.int64]

READOUT_SIGMA = 1.0  # frames, of a rolling shutter of which nothing is known
_DISTORTION_SIGMA = 0.1
_CENTER_SIGMA = 0.02  # of the width


@dataclass(frozen=True, slots=True)
class Lens:
    """(g,) focal lengths (pixels), and (6,) shape as in `State.lens`."""

    focal: Array
    shape: Array = field(default_factory=lambda: np.zeros(LENS_SIZE))

    @property
    def bends(self) -> bool:
        """Whether there is distortion or a principal point elsewhere."""
        return bool(self.shape[DISTORTION].any())


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """What became of an unknown lens.

    Attributes:
        guess: with which the tracks were undistorted; lens: what the shot says, or the guess.
        focal_std: (g,) relative standard deviations of the estimated focal lengths, believed or not; 0 of known ones.
        shape_std: (6,) standard deviations of the shape, NaN where it stays as guessed.
        misfit_px: standard deviation of the tracks where they fit no lens: what an estimate says is chance then;
            0 where they do.
        determined: whether the focal lengths are estimates, not the guess.
        rough: whether they are not, but the shot knows more than the guess: means of both, each as it is known.
        zoom_std: relative standard deviation of the ratio of the longest to the shortest focal length where a zoom was
            looked for, whether one was found or not; None: none was. The course of a zoom is an estimate in any case.
    """

    guess: Lens
    lens: Lens
    focal_std: Array
    shape_std: Array
    misfit_px: float
    determined: bool
    rough: bool = False
    zoom_std: float | None = None

    def renormalize(self, observations: Observations, group: Index) -> Observations:
        """What was undistorted by the guess, undistorted by the lens; `group` as in `State`."""
        return renormalized(observations, self.guess, self.lens, group)


def shape_sigmas(freedom: LensFreedom, width: float) -> Array:
    """(4,) with which distortion and principal point are known beforehand; `width`: of what is seen, normalised."""
    distortion = 0.0 if freedom in ("auto", "fixed", "focal") else _DISTORTION_SIGMA
    center = _CENTER_SIGMA * width if freedom == "all" else 0.0
    return np.array([distortion, distortion, center, center])


def undistort(xy: Array, shape: Array) -> Array:
    """Inverse of `factors.distort`: (n, 2) undistorted coordinates, NaN where there are none."""
    if not shape[DISTORTION].any():
        return xy
    k1, k2, x, y = shape[DISTORTION]
    camera = pycolmap.Camera(model="RADIAL", width=1, height=1, params=[1.0, x, y, k1, k2])
    return np.asarray(camera.cam_from_img(xy), np.float64)


def renormalized(observations: Observations, before: Lens, after: Lens, group: Index) -> Observations:
    """The same pixels, undistorted by another lens; `group` as in `State`."""
    seen = distort(observations.xy, before.shape)[0] if before.bends else observations.xy
    mine = group[observations.frame]
    ratio = (before.focal / after.focal)[mine, None]
    swept = observations.swept(before.shape[READOUT]) - observations.swept(after.shape[READOUT])
    return replace(observations, xy=undistort(seen * ratio + swept / after.focal[mine, None], after.shape))


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
