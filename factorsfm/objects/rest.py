"""The scale of an object from a time at which it rests: then it is part of the scene, which has a scale.

Its points stand still while the camera passes them, so that the path of the camera measures them. But what moves as the
camera does, only less, looks the same: a car beside a dolly, on a straight way. So a rest must be told from any steady
motion of the object, which is possible where the camera itself does not move steadily.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.objects.scale import Scale
from factorsfm.support.rotations import logarithm

Array = NDArray[np.float64]

_LEAST_FRAMES = 8  # of a rest; for a moment everything may seem to rest
_GRID = 32  # moments of the shot between which rests are looked for
_SIGMAS = 3.0  # within which something is as at rest
_LARGEST_RESIDUAL = 0.05  # of the path of the camera: what remains may be a motion
_LARGEST_STD = 0.1  # relative, where a steady motion is estimated, too


@dataclass(frozen=True, slots=True)
class Sighting:
    """An object in k frames, its unit of length open.

    Attributes:
        rotation: (k, 3, 3) world_from_object.
        centre: (k, 3) of the cameras, in the world; offset: (k, 3) from there to the object, along the axes of the
            world, in units of the object.
        covariance: (k, 6, 6) of world_from_object for a perturbation on the right, in units of the object.
    """

    rotation: Array
    centre: Array
    offset: Array
    covariance: Array


def scale_at_rest(seen: Sighting) -> Scale | None:
    """From the longest rest; None where there is none that can be told from a steady motion."""
    count = len(seen.centre)
    grid = np.unique(np.linspace(0, count - 1, _GRID).round().astype(int))
    stretches = [(a, b + 1) for a in grid for b in grid if b + 1 - a >= _LEAST_FRAMES]
    for a, b in sorted(stretches, key=lambda ends: ends[0] - ends[1]):
        if _turns(seen, a, b):
            continue
        found = _solved(seen, a, b)
        if found is not None:
            return found
    return None


def _turns(seen: Sighting, a: int, b: int) -> bool:
    """Whether the object turns between two frames, by more than is uncertain."""
    middle = seen.rotation[(a + b) // 2]
    turn = logarithm(np.einsum("kji,jl->kil", seen.rotation[a:b], middle))
    covariance = seen.covariance[a:b, :3, :3]
    variance = np.einsum("kii->k", covariance) + np.trace(covariance[(b - a) // 2])
    return bool((np.linalg.norm(turn, axis=1) > _SIGMAS * np.sqrt(variance)).any())


def _solved(seen: Sighting, a: int, b: int) -> Scale | None:
    """The scale at which the object rests between two frames, if it does."""
    centre, offset = seen.centre[a:b], seen.offset[a:b]
    spread = float(np.sqrt(((centre - centre.mean(0)) ** 2).sum(1).mean()))
    if spread == 0.0:
        return None
    turned = np.einsum("kij,kjl,kml->kim", seen.rotation[a:b], seen.covariance[a:b, 3:, 3:], seen.rotation[a:b])
    sigma = float(np.sqrt(np.median(np.linalg.eigvalsh(turned)[:, -1])))
    at_rest, rest_std, residual = _fit(centre, offset, steady=False)
    moving, steady_std, _ = _fit(centre, offset, steady=True)
    if at_rest <= 0.0 or moving <= 0.0:
        return None
    noise = at_rest * sigma
    known = steady_std * max(noise, residual) < _LARGEST_STD * moving
    same = abs(moving - at_rest) < _SIGMAS * steady_std * max(noise, residual)
    rests = residual < min(_SIGMAS * noise, _LARGEST_RESIDUAL * spread)
    if not (known and same and rests):
        return None
    return Scale(at_rest, max(rest_std * max(noise, residual) / at_rest, residual / spread), b - a, "rest")


def _fit(centre: Array, offset: Array, *, steady: bool) -> tuple[float, float, float]:
    """The scale with which ``centre + scale * offset`` is one place, or moves steadily.

    Returns:
        It, its standard deviation for errors of unit variance, and the root mean square of what remains.
    """
    count = len(centre)
    time = np.linspace(-1.0, 1.0, count)
    basis = np.stack([np.ones(count), time], 1) if steady else np.ones((count, 1))
    across = np.eye(count) - basis @ np.linalg.pinv(basis)
    path, way = across @ centre, across @ offset
    power = float((way**2).sum())
    scale = -float((path * way).sum()) / power
    residual = float(np.sqrt(((path + scale * way) ** 2).sum() / max(3 * (count - basis.shape[1]) - 1, 1)))
    return scale, 1.0 / np.sqrt(power), residual
