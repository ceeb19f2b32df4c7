"""What moves: whether the camera translates, only turns, or stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.support.options import PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]

_STATIC_SHARE = 0.004  # largest median displacement of the tracks of a static shot, in focal lengths
# Noise costs one unit per observation (two coordinates, half a unit each). Translation and depths fit some of it; they
# count as observed when they explain at least half as much again as noise. On tripod shots the gain is 0.05 to 0.15,
# on the first ten frames of slow moves 1.5 and more.
LEAST_GAIN = 0.5
CLEAR_GAIN = 2.0 * LEAST_GAIN  # on few of the frames, at which all of them need not be asked
_CLOSE = 1.5  # factor on it between which the verdict is doubtful


@dataclass(frozen=True, slots=True)
class Motion:
    """Kind of a shot's motion, with the numbers that decided.

    Attributes:
        displacement_px: largest median displacement of the tracks against their first appearance.
        gain: decrease of the cost by translation and depth, per observation of the median track.
        rotation_only: the solution without translation.
    """

    kind: ShotKind
    displacement_px: float
    gain: float
    rotation_only: State

    @property
    def close(self) -> bool:
        """Whether rotation and general motion are nearly as good readings of a camera that is not static."""
        return self.kind is not ShotKind.STATIC and LEAST_GAIN / _CLOSE < self.gain < LEAST_GAIN * _CLOSE


def displacement(observations: Observations, xy: Array) -> float:
    """Largest median displacement of the tracks of a frame against their first observation, normalised as `xy`."""
    o = observations
    moved = np.linalg.norm(xy - xy[o.first[o.point]], axis=1)
    order = np.argsort(o.frame, kind="stable")
    parts = np.split(moved[order], np.nonzero(np.diff(o.frame[order]))[0] + 1)
    return max(float(np.median(part)) for part in parts)


def classify_motion(adjustment: BundleAdjustment, options: PolishOptions) -> Motion:
    """Static, pure rotation, or general motion: does translation explain what rotation alone cannot?

    Args:
        adjustment: converged over poses and points.
    """
    state, observations = adjustment.state, adjustment.observations
    start, xy = observations.first, state.normalized(observations)
    rays = np.concatenate([xy[start], np.ones((len(start), 1))], 1)
    rays = np.einsum("nji,nj->ni", state.rotation[observations.frame[start]], rays)
    rotation_only = BundleAdjustment(
        replace(
            state,
            translation=np.zeros_like(state.translation),
            bearing=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        ),
        observations,
        replace(options, iterations=6, tolerance=1e-2),
        ErrorModel(adjustment.sigma),
        free=Free(translation=False),
    )
    rotation_only.solve()
    gain = translation_gain(rotation_only, adjustment)
    moved = displacement(observations, xy)
    kind = ShotKind.ROTATION if moved > _STATIC_SHARE else ShotKind.STATIC
    if gain > LEAST_GAIN:
        kind = ShotKind.GENERAL
    return Motion(kind, moved * float(np.median(state.focal)), gain, rotation_only.state)


def translation_gain(rotation_only: BundleAdjustment, adjustment: BundleAdjustment) -> float:
    """Decrease of the cost by translation and depth, per observation of the median track, of the same observations."""
    difference = rotation_only.observation_costs() - adjustment.observation_costs()
    # Median over the tracks: what moves by itself must not move the camera.
    return float(np.median(adjustment.observations.mean_by_point(difference)))
