"""What rests in the image all the while: the sign of a fixed camera, whatever else moves before it.

A camera that is held or carried leaves no pixel in its place for a second. A fixed one leaves every static point where
it is, to the noise of the tracker. So a good part of the image that rests in every frame speaks for a fixed camera,
unless one general motion explains what does not rest: then what rests is far away, or laid over the images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import coordinate_sigma, image_cells
from factorsfm.adjustment.observations import Observations

Array = NDArray[np.float64]

# Typical distance of a point from its place (pixels). What rests stays within 0.03 to 0.2; before a camera in the hand
# nothing stays within 0.8 over three seconds, and before a slow dolly what is far passes through this in a few frames.
_RESTS_PX = 0.25
_LONG = 0.25  # of the shot, for which a point must be seen: everything rests for a moment
_ALWAYS = 0.25  # share of the frames in which less may rest: a slow start is no rest
_CELLS = (8, 5)  # across and down; each counts once, however many tracks it has
_NOISES = 3.0  # standard deviations within which something is explained
_LEAST_NOISE_PX = 0.1
LEAST_SHARE = 0.08  # of the image; behind a face that fills most of it little more is seen, and a moving camera has 0
_LEAST_SPREAD = 3  # rows and columns of cells: captions and logos lie along the border, a background everywhere
_MOST_OF_THE_OTHERS = 0.5  # a general motion that explains less of what does not rest is none


@dataclass(frozen=True, slots=True)
class Rest:
    """What rests in the image while other things move.

    Attributes:
        share: of the image that rests in most frames.
        explained: share of what does not rest that one general motion of the camera explains.
    """

    share: float
    explained: float

    @property
    def fixed(self) -> bool:
        """Whether it speaks for a fixed camera before things that move by themselves."""
        return self.explained <= _MOST_OF_THE_OTHERS


def at_rest(observations: Observations) -> NDArray[np.bool_]:
    """(n,) which points rest in the image for long."""
    o = observations
    start = o.first
    length = np.diff(np.append(start, len(o.point)))
    off = np.linalg.norm(o.pixels - _places(o)[o.point], axis=1)
    typical = np.array([np.median(part) for part in np.split(off, start[1:])])
    return np.asarray((typical < _RESTS_PX) & (length >= _LONG * len(np.unique(o.frame))))


def resting_share(observations: Observations, rests: NDArray[np.bool_]) -> float:
    """Share of what is seen of the image that rests in most frames; 0 where it all lies in one strip."""
    row, column = np.divmod(image_cells(observations.pixels, *_CELLS)[rests[observations.point]], _CELLS[0])
    if min(len(np.unique(row)), len(np.unique(column))) < _LEAST_SPREAD:
        return 0.0
    weight = image_weights(observations)
    whole = np.bincount(observations.frame, weight)
    part = np.bincount(observations.frame, weight * rests[observations.point], len(whole))
    return float(np.quantile(part[whole > 0] / whole[whole > 0], _ALWAYS))


def share_explained(observations: Observations, errors: Array, rests: NDArray[np.bool_]) -> float:
    """Share of what does not rest that a solution explains to the noise of what does.

    Args:
        errors: (m,) reprojection errors of the solution, infinite for what it leaves out (pixels).
    """
    off = np.linalg.norm(observations.pixels - _places(observations)[observations.point], axis=1)
    still = rests[observations.point]
    noise = max(coordinate_sigma(off[still]), _LEAST_NOISE_PX)
    weight = image_weights(observations) * ~still
    return float(weight[errors < _NOISES * noise].sum() / max(float(weight.sum()), 1e-12))


def image_weights(observations: Observations) -> Array:
    """(m,) weights with which each part of the image counts the same, whatever number of observations it has."""
    cell = image_cells(observations.pixels, *_CELLS)
    return np.asarray(1.0 / np.bincount(cell)[cell])


def _places(observations: Observations) -> Array:
    """(n, 2) median position of each point in the image."""
    parts = np.split(observations.pixels, observations.first[1:])
    return np.array([np.median(part, axis=0) for part in parts])
