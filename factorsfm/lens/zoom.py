"""A zoom: the focal length of every frame, which changes smoothly over the shot."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, FocalPrior
from factorsfm.adjustment.semidefinite import squared_deviations
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.lens.certainty import lens_covariances
from factorsfm.lens.estimate import solved_with_lens
from factorsfm.lens.lens import Lens
from factorsfm.motion.shot_kind import LEAST_GAIN, translation_gain
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_SHORTEST = 8  # frames in which a zoom is looked for
_FIRST_SPREAD = 0.003  # of the acceleration of log focal length, per frame: a fast zoom by hand
_LEAST_SPREAD = 1e-5
# Of the mean log focal length around the guess, while the change is looked for: a turning camera says something of it,
# of a moving one it is better held.
_TURNING_LEVEL_SIGMA, _MOVING_LEVEL_SIGMA = 0.3, 0.001
_FLAT_ITERATIONS = 15
_ROUNDS = 2
_CLEARLY = 0.95  # of the cost of the start that takes no side, at which the motion of the map is preferred
_COMPONENTS = 4  # of slow change, in which a zoom must show itself
_LEAST_EVIDENCE = 16.0  # squared standard deviations
_LEAST_ZOOM = 0.02  # of log focal length: less is what tracks of moving things make, or focus


@dataclass(frozen=True, slots=True)
class Zoom:
    """A change of focal length, the focal length as a whole being a guess.

    Attributes:
        found: whether the shot shows it.
        adjustment: converged with it, a focal length for every frame.
        information: (k, k) of the log focal lengths from the smoothness of the change.
        std: relative standard deviation of the ratio of the longest to the shortest focal length.
    """

    found: bool
    adjustment: BundleAdjustment
    information: Array
    std: float


def find_zoom(known: BundleAdjustment, guess: Lens, times: Array, options: PolishOptions) -> Zoom | None:
    """The change of focal length over the frames, None where they are too few to tell.

    A zoom looks like motion along the view axis, and so the map's motion is wrong where there is one. The start is a
    camera that turns and zooms before points at one distance; translation and distances are freed from there.

    Args:
        known: converged with one focal length, that of the guess; times: (k,) of its frames, in frames.
    """
    state, count = known.state, len(times)
    if count < _SHORTEST:
        return None
    own = replace(state, log_focal=np.repeat(state.log_focal, count), group=np.arange(count))
    flat = replace(
        own,
        translation=np.zeros_like(state.translation),
        inverse_distance=np.full(len(state.inverse_distance), float(np.median(state.inverse_distance))),
    )
    few = replace(options, iterations=_FLAT_ITERATIONS)
    prior = FocalPrior(own.log_focal, _information(times, _FIRST_SPREAD) + _level(count, _TURNING_LEVEL_SIGMA))
    turning = solved_with_lens(flat, known.observations, few, 1.0, np.zeros(LENS_SIZE), moves=False, focal_prior=prior)
    mean = own.log_focal
    turning, turning_spread = _solved(
        turning.state, turning.observations, known.sigma, mean, times, options, moves=False
    )
    best, spread = _solved(turning.state, turning.observations, known.sigma, mean, times, options)
    other, other_spread = _solved(own, known.observations, known.sigma, mean, times, options)
    cost, other_cost = (problem.cost() for problem in _at_one_scale(best, other))
    logger.debug(
        "zoom: cost %.0f from a turning camera, %.0f from the map; gain %.2f by translation",
        cost, other_cost, translation_gain(*_at_one_scale(turning, best)),
    )  # fmt: skip
    if other_cost < _CLEARLY * cost:
        best, spread = other, other_spread
    if translation_gain(*_at_one_scale(turning, best)) < LEAST_GAIN:
        best, spread = turning, turning_spread
    log_focal = best.state.log_focal
    change = float(np.ptp(log_focal))
    between = np.zeros((1, count))
    between[0, [np.argmin(log_focal), np.argmax(log_focal)]] = -1.0, 1.0
    slow = np.cos(np.pi / count * np.outer(np.arange(1, _COMPONENTS + 1), np.arange(count) + 0.5))
    covariances = lens_covariances(best)
    std = float(np.sqrt(max((between @ c @ between.T).item() for c in covariances)))
    away = slow @ log_focal
    evidence = min(squared_deviations(away, slow @ c @ slow.T) for c in covariances)
    logger.info(
        "zoom of %.2f %% within %.2f %%, %.0f squared deviations; spread %.1e a frame, tracks %.3f px (%.3f without)",
        100 * np.expm1(change), 100 * std, evidence, spread, best.sigma, known.sigma,
    )  # fmt: skip
    found = change > _LEAST_ZOOM and min(evidence, (change / std) ** 2) > _LEAST_EVIDENCE
    settled = BundleAdjustment(best.state, best.observations, options, ErrorModel(best.sigma))
    settled.solve()
    return Zoom(found, settled, _information(times, spread), std)


def _at_one_scale(*problems: BundleAdjustment) -> list[BundleAdjustment]:
    """The same with the noise of the last one."""
    return [BundleAdjustment(p.state, p.observations, p.options, ErrorModel(problems[-1].sigma)) for p in problems]


def _solved(
    state: State,
    observations: Observations,
    sigma: float,
    mean: Array,
    times: Array,
    options: PolishOptions,
    *,
    moves: bool = True,
) -> tuple[BundleAdjustment, float]:
    """Converged over the change, and the spread of its acceleration, by expectation and maximisation."""
    bend, spread, level = _bend(times), _FIRST_SPREAD, _MOVING_LEVEL_SIGMA if moves else _TURNING_LEVEL_SIGMA
    for _ in range(_ROUNDS):
        prior = FocalPrior(mean, _information(times, spread) + _level(len(times), level))
        problem = solved_with_lens(
            state, observations, options, sigma, np.zeros(LENS_SIZE), moves=moves, focal_prior=prior
        )
        state, observations, sigma = problem.state, problem.observations, problem.sigma
        uncertain = (bend @ lens_covariances(problem)[0] @ bend.T).diagonal()
        spread = max(float(np.sqrt(np.mean((bend @ state.log_focal) ** 2 + uncertain))), _LEAST_SPREAD)
    return problem, spread


def _bend(times: Array) -> Array:
    """(k - 2, k) from values to changes of their speed, which are all alike where the acceleration is white noise."""
    step = np.diff(times)
    speed = np.diff(np.eye(len(times)), axis=0) / step[:, None]
    return np.asarray(np.diff(speed, axis=0) / np.sqrt(0.5 * (step[1:] + step[:-1]))[:, None])


def _information(times: Array, spread: float) -> Array:
    bend = _bend(times)
    return np.asarray(bend.T @ bend / spread**2)


def _level(count: int, sigma: float) -> Array:
    """Information that holds the mean."""
    return np.full((count, count), 1.0 / (count * sigma) ** 2)
