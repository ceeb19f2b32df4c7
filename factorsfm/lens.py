"""A lens with unknown focal length and distortion, and what is seen through another one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.factors import distort
from factorsfm.problem import Observations, State

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Lens:
    """(g,) focal lengths (pixels), and (4,) distortion and principal point as in `factors.distort`."""

    focal: Array
    shape: Array


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """What became of an unknown lens.

    Attributes:
        guess: with which the tracks were undistorted; lens: what the shot says, or the guess.
        focal_std: (g,) relative standard deviations of the estimated focal lengths, believed or not; 0 of known ones.
        shape_std: (4,) standard deviations of the shape, NaN where it stays as guessed.
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


def undistort(xy: Array, shape: Array) -> Array:
    """Inverse of `factors.distort`: (n, 2) undistorted coordinates, NaN where there are none."""
    if not shape.any():
        return xy
    k1, k2, x, y = shape
    camera = pycolmap.Camera(model="RADIAL", width=1, height=1, params=[1.0, x, y, k1, k2])
    return np.asarray(camera.cam_from_img(xy), np.float64)


def renormalized(observations: Observations, before: Lens, after: Lens, group: Index) -> Observations:
    """The same pixels, undistorted by another lens; `group` as in `State`."""
    seen = distort(observations.xy, before.shape)[0] if before.shape.any() else observations.xy
    ratio = (before.focal / after.focal)[group[observations.frame], None]
    return replace(observations, xy=undistort(seen * ratio, after.shape))


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
