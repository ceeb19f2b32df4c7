"""Simple readings of a shot, which a general motion of the camera has to beat: it rests, or it only turns.

A general motion has three numbers more for a frame and one for a point. They fit what moves by itself, a wrong focal
length and a rolling shutter, so that it always fits better; the simple readings are tried by themselves.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, typical_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.lens.rolling_shutter import turns_before_shutter
from factorsfm.lens.turning import FACTORS, turning_camera
from factorsfm.motion.at_rest import LEAST_SHARE, Rest, at_rest, resting_share, share_explained
from factorsfm.motion.readings import solution_from
from factorsfm.motion.shot_kind import classify_motion
from factorsfm.polish.camera_starts import CameraSolution, on_what_fits
from factorsfm.support.options import Options
from factorsfm.support.status import ShotKind

logger = logging.getLogger(__name__)

# Of a turning camera (standard deviation, pixels), above which it is not looked at more closely. Pans before a rolling
# shutter have 0.3; the smallest translation among handheld shots leaves 0.6.
_TURNING_PX = 2.0 * FIRST_SIGMA_PX


def turning_reading(guess: State, few: Observations, options: Options, *, lens_solved: bool) -> CameraSolution | None:
    """The cameras on the core tracks from one that only turns, where that explains them, through an unknown lens.

    With a known lens the solution from the map tells; through a wrong one it takes a pan for a translation.

    Args:
        lens_solved: whether the lens of the guess is that of an earlier solve.
    """
    if not options.refine_focal_length or len(guess.log_focal) > 1:
        return None
    start = turning_camera(guess, few, options.polish, (1.0,) if lens_solved else FACTORS)
    sigma = typical_sigma(BundleAdjustment(start, few, options.polish, ErrorModel(1.0)).reprojection_errors())
    logger.info("a turning camera of focal length %.0f pixels leaves %.2f px", start.focal[0], sigma)
    if sigma > _TURNING_PX:
        return None
    found = on_what_fits(start, few, options)
    motion = classify_motion(found.adjustment, options.polish)
    logger.info("translation explains %.2f more of an observation than turning alone", motion.gain)
    if motion.kind is ShotKind.STATIC:  # it says nothing of its lens
        return None
    turns = motion.kind is ShotKind.ROTATION
    if not turns and found.adjustment.observations.sweep is not None:
        turns = turns_before_shutter(found.adjustment, motion, options) is not None
    return replace(found, turns=True) if turns else None


def unless_at_rest(found: CameraSolution, guess: State, few: Observations, options: Options) -> CameraSolution:
    """A camera solution, or that of a fixed camera where more speaks for it.

    Args:
        guess: with the lens; found: on the points of the guess.
    """
    rests = at_rest(few)
    if rests.all() or (share := resting_share(few, rests)) < LEAST_SHARE:
        return found
    errors = np.full(len(few.frame), np.inf)
    errors[np.isin(few.point, found.kept)] = found.adjustment.reprojection_errors()
    rest = Rest(share, share_explained(few, errors, rests))
    logger.info("%.0f %% of the image rests; %.0f %% of the others move as one", 100 * share, 100 * rest.explained)
    if not rest.fixed:
        return replace(found, rest=rest)
    still = np.nonzero(rests)[0]
    part = few.of(still)
    solved = solution_from(_standing(guess.of(still), part), part, options.polish)
    return CameraSolution(still, solved, int((~rests).sum()), rest=rest)


def _standing(guess: State, observations: Observations) -> State:
    """A fixed camera before points at one distance."""
    xy = guess.normalized(observations)[observations.first]
    bearing = np.column_stack([xy, np.ones(len(xy))])
    return replace(
        guess,
        rotation=np.tile(np.eye(3), (len(guess.rotation), 1, 1)),
        translation=np.zeros_like(guess.translation),
        bearing=bearing / np.linalg.norm(bearing, axis=1, keepdims=True),
        inverse_distance=np.ones(len(xy)),
    )
