"""Near and far: the depth prior beside the geometry, and the reversed scene where the prior says the opposite.

In a narrow view a scene with near and far exchanged, and the motion reversed, shows almost the same images (Necker's
reversal). The images decide where they can; where both fit alike, a prior that says the opposite of one of them does.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.prior_term import LEAST_CORRELATION, WeighedPrior, weigh_prior
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.some_frames import on_some_frames
from factorsfm.motion.readings import reversed_scene, solution_from
from factorsfm.polish.camera_starts import Index
from factorsfm.support.options import Options
from factorsfm.tracks.image_tracks import ImageTracks

logger = logging.getLogger(__name__)

# By how much the cost of the reversed scene may be higher, for independent errors, and the prior still decide. On
# rendered shots of rigid scenes the network has correlations of 0.6 to 0.96; beside large figures that move by
# themselves down to -0.36. One in fifty that is negative for a right scene is a cost of 4.
_PRIOR_DECIDES = 4.0


@dataclass(frozen=True, slots=True)
class NearAndFar:
    """The cameras, and the prior beside them.

    Attributes:
        adjustment: converged, of the scene or its reversal.
        prior: with the weight that it earns; None without one, or where it contradicts the geometry.
        correlation: of a prior that contradicts the geometry, with its inverse depths; None where none does.
    """

    adjustment: BundleAdjustment
    prior: WeighedPrior | None = None
    correlation: float | None = None


def near_and_far(
    solved: BundleAdjustment, tracks: Index, images: Sequence[ImageTracks], inflation: float, options: Options
) -> NearAndFar:
    """Weigh the prior, and try the reversed scene where it says the opposite.

    Args:
        solved: converged over cameras and points; tracks: id of each point; images: those of the cameras.
        inflation: of the variance, since errors repeat themselves.
    """
    if not options.polish.depth:
        return NearAndFar(solved)
    prior = weigh_prior(solved, solved.observations, tracks, images, inflation)
    if prior is None or prior.weight.correlation >= LEAST_CORRELATION:
        return NearAndFar(solved, prior)
    correlation = prior.weight.correlation
    if correlation >= 0.0:
        return NearAndFar(solved, None, correlation)
    few = on_some_frames(solved)
    parts = [few, solved] if len(few.state.rotation) < len(solved.state.rotation) else [solved]
    for part in parts:  # more frames only add to what the images say against it
        other = solution_from(reversed_scene(part.state), part.observations, options.polish)
        loss = _cost(other, solved.sigma) - _cost(part, solved.sigma)
        logger.info("the prior says the opposite; the reversed scene costs %.1f more", loss / inflation)
        if loss >= _PRIOR_DECIDES * inflation:
            return NearAndFar(solved, None, correlation)
    again = weigh_prior(other, other.observations, tracks, images, inflation)
    fits = again is not None and again.weight.correlation >= LEAST_CORRELATION
    return NearAndFar(other, again) if fits else NearAndFar(solved, None, correlation)


def _cost(adjustment: BundleAdjustment, sigma: float) -> float:
    """Of the observations alone, at a common noise."""
    problem = BundleAdjustment(adjustment.state, adjustment.observations, adjustment.options, ErrorModel(sigma))
    return float(problem.observation_costs().sum())
