"""What the motion of a shot lets one recover."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.options import PolishOptions
from factorsfm.reconstruction import ShotKind
from factorsfm.refinement import BundleAdjustment, Observations, State

Array = NDArray[np.float64]

_STATIC_PX = 0.4  # largest median displacement of the tracks of a static shot
# The residuals of neighbouring frames are alike, so that a shot holds fewer measurements than observations: gains in
# likelihood are divided by this before they are held against the number of parameters.
_CORRELATED_FRAMES = 5.0


@dataclass(frozen=True, slots=True)
class Motion:
    """Kind of a shot's motion, with the numbers that decided.

    Attributes:
        displacement_px: largest median displacement of the tracks against their first appearance.
        gain: decrease of the cost by translation and depth, in effective measurements.
        needed: gain from which translation counts as observed (Bayesian information criterion).
        rotation_only: the solution without translation.
    """

    kind: ShotKind
    displacement_px: float
    gain: float
    needed: float
    rotation_only: State


def displacement(observations: Observations, focal: float) -> float:
    """Largest median displacement (pixels) of the tracks of a frame against their first observation."""
    o = observations
    first = np.searchsorted(o.point, np.arange(o.point[-1] + 1))
    moved = np.linalg.norm(o.xy - o.xy[first[o.point]], axis=1) * focal
    order = np.argsort(o.frame, kind="stable")
    parts = np.split(moved[order], np.nonzero(np.diff(o.frame[order]))[0] + 1)
    return max(float(np.median(part)) for part in parts)


def classify_motion(
    adjustment: BundleAdjustment, observations: Observations, options: PolishOptions
) -> Motion:
    """Static, pure rotation, or general motion: does translation explain what rotation alone cannot?

    Args:
        adjustment: converged over poses and points of `observations`.
    """
    state = adjustment.state
    start = np.searchsorted(observations.point, np.arange(len(state.bearing)))
    rays = np.concatenate([observations.xy[start], np.ones((len(start), 1))], 1)
    rays = np.einsum("nji,nj->ni", state.rotation[observations.frame[start]], rays)
    rotation_only = BundleAdjustment(
        replace(
            state,
            translation=np.zeros_like(state.translation),
            bearing=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        ),
        observations,
        replace(options, iterations=15),
        sigma=adjustment.sigma,
        free_translation=False,
    )
    rotation_only.solve()
    gain = (rotation_only.cost() - adjustment.cost()) / _CORRELATED_FRAMES
    parameters = 3 * (len(state.rotation) - 1) + len(state.bearing)
    needed = 0.5 * parameters * float(np.log(2 * len(observations.xy)))
    moved = displacement(observations, float(np.exp(state.log_focal)))
    kind = ShotKind.GENERAL if gain > needed else ShotKind.ROTATION
    if moved < _STATIC_PX:
        kind = ShotKind.STATIC
    return Motion(kind, moved, gain, needed, rotation_only.state)
