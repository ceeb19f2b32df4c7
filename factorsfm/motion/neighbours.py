"""What the neighbours of a track say of it: a single one may fit, or miss, by chance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_NEIGHBOURS = 10  # points, with the one that is judged
_ACROSS, _DOWN = 32, 18  # places of the image, each of which is what the point nearest to it is
_REACH, _FRAMES = 8, 16  # a step of an eighth of the image leads as far away as one of so many frames


def places(observations: Observations) -> Array:
    """(n, 3) where in the image, and when, each point is halfway through its track, in steps of equal weight."""
    first = observations.first
    middle = (first + np.append(first[1:], len(observations.point)) - 1) // 2
    pixels = observations.pixels[middle]
    step = max(float(np.ptp(pixels, axis=0).max()) / _REACH, 1e-9)
    return np.column_stack([pixels / step, observations.frame[middle] / _FRAMES])


def share_nearby(among: Array, flags: Flags, judged: Flags | None = None) -> Array:
    """(k,) share of the points around each judged place that have a flag, if one more had none.

    Args:
        among: (n, 3) places; flags: (n,) by place; judged: (n,) which places are, None: all.
    """
    count = min(_NEIGHBOURS, len(among))
    found = [
        flags[np.argpartition(np.linalg.norm(among - place, axis=1), count - 1)[:count]].sum()
        for place in (among if judged is None else among[judged])
    ]
    return np.array(found) / (count + 1)


def share_of_image(xy: Array, flags: Flags, size: tuple[int, int]) -> float:
    """Share of the places of an image to which the nearest point is one with a flag.

    Args:
        xy: (n, 2) pixels; flags: (n,); size: width and height.
    """
    v, u = np.divmod(np.arange(_ACROSS * _DOWN), _ACROSS)
    places = (np.column_stack([u, v]) + 0.5) * np.array(size) / [_ACROSS, _DOWN] - 0.5
    away = (xy**2).sum(axis=1) - 2.0 * places @ xy.T  # squared distance, but for what is the same for all points
    return float(flags[np.argmin(away, axis=1)].mean())
