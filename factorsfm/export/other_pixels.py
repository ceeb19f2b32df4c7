"""A result as seen by other cameras at the same places: of another size, or without distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.result.reconstruction import Reconstruction

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def in_other_pixels(
    reconstruction: Reconstruction,
    lens: Callable[[pycolmap.Camera], pycolmap.Camera],
    placed: Callable[[pycolmap.Camera, Array], Array],
) -> Reconstruction:
    """The result through other lenses.

    Args:
        lens: the new camera in place of an old one; placed: (n, 2) pixels of the new camera, centres at integers, of
            (n, 2) pixels of the old one.
    """
    frames = reconstruction.frames

    def moved(xy: Array, frame: Index) -> Array:
        """Where places are, by the position of their frame."""
        if not reconstruction.has_own_lenses:
            return placed(reconstruction.camera, xy)
        new = np.array(xy, np.float64)
        for position in np.unique(frame):
            rows = frame == position
            new[rows] = placed(reconstruction.camera_of(frames[position]), xy[rows])
        return new

    moving = reconstruction.moving
    if moving is not None:
        position = np.searchsorted([frame.index for frame in frames], moving.frame)
        moving = replace(moving, xy=moved(moving.xy, position))
    return replace(
        reconstruction,
        camera=lens(reconstruction.camera),
        frames=[replace(f, camera=None if f.camera is None else lens(f.camera)) for f in frames],
        observation_xy=moved(reconstruction.observation_xy, reconstruction.observation_frame),
        moving=moving,
        noise=None,
        rolled=None,
    )
