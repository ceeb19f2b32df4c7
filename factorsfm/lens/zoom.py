"""A zoom: a focal length for every frame that changes smoothly over the shot."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import FocalPrior
from factorsfm.adjustment.some_frames import some_frames
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.lens.certainty import lens_covariances
from factorsfm.lens.solver import LensSolver, NotInvertibleError
from factorsfm.motion.readings import Reading, cost, solution_from
from factorsfm.motion.shot_kind import LEAST_GAIN, translation_gain
from factorsfm.support.options import PolishOptions
from factorsfm.support.semidefinite import squared_deviations

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_SHORTEST = 8  # frames in which a zoom is looked for
_FIRST_SPREAD = 0.003  # of the acceleration of log focal length, per frame: a fast zoom by hand
_LEAST_SPREAD = 1e-5
# Standard deviations of the mean log focal length around the guess while the change is searched: a turning camera shows
# the focal length, for a moving one it is better fixed.
_TURNING_LEVEL_SIGMA, _MOVING_LEVEL_SIGMA = 0.3, 0.001
_FLAT_ITERATIONS = 15
_ROUNDS = 2
_CLEARLY = 0.95  # of the cost of the solution from a turning camera, below which that from the map is preferred
_COMPONENTS = 4  # slow cosines in which a zoom must be significant
_LEAST_EVIDENCE = 16.0  # squared standard deviations
# Of the cost with one focal length: below, there is no doubt of a zoom, or a reason to try one.
_CERTAIN, _SUSPECTED = 0.5, 0.8
_MOST = 0.9  # of the tracks: a solution with fewer of them is no better than one with a zoom that has all
_FLAT = 0.1  # of log depth, between a tenth of the points at either end: a room seen head-on has 0.3
_LEAST_ZOOM = 0.02  # of log focal length: moving things and focus pulls change it by less


@dataclass(frozen=True, slots=True)
class Zoom:
    """A change of focal length around a mean that is still a guess.

    Attributes:
        found: whether the shot shows it.
        adjustment: converged with it, a focal length for every frame.
        information: (k, k) of the log focal lengths from the smoothness of the change.
        std: relative standard deviation of the ratio of the longest to the shortest focal length.
        turns: whether the camera does no more than turn.
        certain: whether there is no doubt of it, where nobody has announced it.
    """

    found: bool
    adjustment: BundleAdjustment
    information: Array
    std: float
    turns: bool
    certain: bool = True

    @property
    def ratio(self) -> float:
        """The longest focal length over the shortest."""
        return float(np.exp(np.ptp(self.adjustment.state.log_focal)))


def find_zoom(known: BundleAdjustment, times: Array, options: PolishOptions) -> Zoom | None:
    """The change of focal length over the frames, None where they are too few to tell.

    Args:
        known: converged with one focal length; times: (k,) of its frames, in frames.
    """
    if len(times) < _SHORTEST:
        return None
    best, spread, turns = _most_probable(known, times, options)
    std, evidence = _certainty(best)
    change = float(np.ptp(best.state.log_focal))
    logger.info(
        "zoom of %.2f %% within %.2f %%, %.0f squared deviations; spread %.1e a frame, tracks %.3f px (%.3f without)",
        100 * np.expm1(change), 100 * std, evidence, spread, best.sigma, known.sigma,
    )  # fmt: skip
    found = change > _LEAST_ZOOM and min(evidence, (change / std) ** 2) > _LEAST_EVIDENCE
    settled = BundleAdjustment(best.state, best.observations, options, best.errors)
    settled.solve()
    return Zoom(found, settled, _information(times, spread), std, turns)


def unannounced_zoom(
    guess: State, few: Observations, fixed: Reading, times: Array, options: PolishOptions, *, doubtful: bool
) -> Zoom | None:
    """A zoom that nobody has asked for, None where one focal length explains the tracks as well.

    Args:
        guess: cameras and points through the first guess of the focal length; few: the tracks of all these points.
        fixed: the best solution with one focal length. Where there is a zoom, what it moves may seem to move by itself
            and be left out of that, and the focal length may be anything: so the zoom starts from the guess.
        times: (k,) of the frames, in frames.
        doubtful: whether the solution does not fit. One that does is none where its scene is flat, and a camera that
            turns and zooms does as well: a zoom looks like a way towards a wall, and is the simpler reading.
    """
    if len(times) < _SHORTEST:
        return None
    doubtful |= len(fixed.kept) < _MOST * len(guess.bearing)
    simpler = not doubtful and _is_flat(fixed.adjustment.state) and _turns_and_zooms(fixed.adjustment, times, options)
    if not (doubtful or simpler):
        return None
    zoom = find_zoom(solution_from(guess, few, options), times, options)
    if zoom is None or not zoom.found:
        return None
    share = _share_of_cost(zoom, fixed, few)
    logger.info("a zoom of %.2f that nobody announced costs %.2f of what one focal length does", zoom.ratio, share)
    simpler &= zoom.turns
    return replace(zoom, certain=simpler or share < _CERTAIN) if simpler or share < _SUSPECTED else None


def _share_of_cost(zoom: Zoom, fixed: Reading, few: Observations) -> float:
    """Cost of all tracks with a zoom over that with one focal length, judged with the same noise."""
    whole = Reading(np.arange(len(zoom.adjustment.state.bearing)), zoom.adjustment)
    sigma = min(zoom.adjustment.sigma, fixed.adjustment.sigma)
    return cost(whole, few, sigma) / max(cost(fixed, few, sigma), 1e-300)


def _is_flat(state: State) -> bool:
    """Whether the scene is a wall across the view of the world's camera."""
    depth = state.bearing[:, 2] / np.maximum(state.inverse_distance, 1e-9)
    near, far = np.quantile(np.maximum(depth, 1e-9), [0.1, 0.9])
    return bool(np.log(far / near) < _FLAT)


def _turns_and_zooms(fixed: BundleAdjustment, times: Array, options: PolishOptions) -> bool:
    """Whether a camera that turns and zooms explains a few frames as well as one that moves with one focal length."""
    frames, part, few = some_frames(fixed.state, fixed.observations)
    general = BundleAdjustment(part, few, options, fixed.errors)
    try:
        _, turning = _turning_start(general, times[frames], options)
    except NotInvertibleError:
        return False
    if float(np.ptp(turning.log_focal)) < _LEAST_ZOOM:
        return False
    gain = translation_gain(*_at_one_scale(BundleAdjustment(turning, few, options, fixed.errors), general))
    logger.info("translation explains %.2f more of an observation than turning and zooming", gain)
    return gain < LEAST_GAIN


def _most_probable(
    known: BundleAdjustment, times: Array, options: PolishOptions
) -> tuple[BundleAdjustment, float, bool]:
    """The best solution with a focal length for every frame, the spread of the acceleration of their logarithms, and
    whether the camera only turns in it.

    A zoom looks like motion along the view axis, and so the map's motion is wrong where there is one. The start is a
    camera that turns and zooms before points at one distance; translation and distances are freed from there.
    """
    own, start = _turning_start(known, times, options)
    zooms = _ZoomSolver(known.observations, own.log_focal, times, options)
    turning, turning_spread = zooms.solved(start, known.sigma, moves=False)
    best, spread = zooms.solved(turning.state, known.sigma)
    other, other_spread = zooms.solved(own, known.sigma)
    cost, other_cost = (problem.cost() for problem in _at_one_scale(best, other))
    logger.debug(
        "zoom: cost %.0f from a turning camera, %.0f from the map; gain %.2f by translation",
        cost, other_cost, translation_gain(*_at_one_scale(turning, best)),
    )  # fmt: skip
    if other_cost < _CLEARLY * cost:
        best, spread = other, other_spread
    turns = translation_gain(*_at_one_scale(turning, best)) < LEAST_GAIN
    return (turning, turning_spread, True) if turns else (best, spread, False)


def _turning_start(known: BundleAdjustment, times: Array, options: PolishOptions) -> tuple[State, State]:
    """The state with a focal length for every frame; and a camera that turns and zooms before points at one distance,
    which explains most."""
    state, count = known.state, len(times)
    own = replace(state, log_focal=np.repeat(state.log_focal, count), group=np.arange(count))
    flat = replace(
        own,
        translation=np.zeros_like(state.translation),
        inverse_distance=np.full(len(state.inverse_distance), float(np.median(state.inverse_distance))),
    )
    prior = FocalPrior(own.log_focal, _information(times, _FIRST_SPREAD) + _level(count, _TURNING_LEVEL_SIGMA))
    few = LensSolver(known.observations, replace(options, iterations=_FLAT_ITERATIONS), prior)
    return own, few.solved(flat, 1.0, np.zeros(LENS_SIZE), moves=False).state


def _certainty(solved: BundleAdjustment) -> tuple[float, float]:
    """Relative standard deviation of the ratio of the extreme focal lengths; squared deviations of all slow change."""
    log_focal = solved.state.log_focal
    count, covariances = len(log_focal), lens_covariances(solved)
    between = np.zeros((1, count))
    between[0, [np.argmin(log_focal), np.argmax(log_focal)]] = -1.0, 1.0
    slow = np.cos(np.pi / count * np.outer(np.arange(1, _COMPONENTS + 1), np.arange(count) + 0.5))
    std = float(np.sqrt(max((between @ c @ between.T).item() for c in covariances)))
    return std, min(squared_deviations(slow @ log_focal, slow @ c @ slow.T) for c in covariances)


def _at_one_scale(*problems: BundleAdjustment) -> list[BundleAdjustment]:
    """The same with the noise of the last one."""
    return [BundleAdjustment(p.state, p.observations, p.options, problems[-1].errors) for p in problems]


@dataclass(frozen=True, slots=True)
class _ZoomSolver:
    """Solves for a focal length of every frame around a mean; `times`: of the frames."""

    observations: Observations
    mean: Array
    times: Array
    options: PolishOptions

    def solved(self, state: State, sigma: float, *, moves: bool = True) -> tuple[BundleAdjustment, float]:
        """Converged over the change, and the spread of its acceleration, by expectation and maximisation."""
        bend, spread = _bend(self.times), _FIRST_SPREAD
        level = _level(len(self.times), _MOVING_LEVEL_SIGMA if moves else _TURNING_LEVEL_SIGMA)
        for _ in range(_ROUNDS):
            prior = FocalPrior(self.mean, _information(self.times, spread) + level)
            solver = LensSolver(self.observations, self.options, prior)
            problem = solver.solved(state, sigma, np.zeros(LENS_SIZE), moves=moves)
            state, sigma = problem.state, problem.sigma
            uncertain = (bend @ lens_covariances(problem)[0] @ bend.T).diagonal()
            spread = max(float(np.sqrt(np.mean((bend @ state.log_focal) ** 2 + uncertain))), _LEAST_SPREAD)
        return problem, spread


def _bend(times: Array) -> Array:
    """(k - 2, k) from values to changes of their speed, of equal variance where the acceleration is white noise."""
    step = np.diff(times)
    speed = np.diff(np.eye(len(times)), axis=0) / step[:, None]
    return np.asarray(np.diff(speed, axis=0) / np.sqrt(0.5 * (step[1:] + step[:-1]))[:, None])


def _information(times: Array, spread: float) -> Array:
    bend = _bend(times)
    return np.asarray(bend.T @ bend / spread**2)


def _level(count: int, sigma: float) -> Array:
    """(k, k) information of a prior on the mean."""
    return np.full((count, count), 1.0 / (count * sigma) ** 2)
