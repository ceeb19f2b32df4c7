"""All cameras solved on the longest tracks, from several starts where the incremental map is bent or depth-reversed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma, image_cells
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.mapping.group_readings import from_group
from factorsfm.motion.at_rest import Rest, image_weights
from factorsfm.motion.burn_ins import contradicts, resting
from factorsfm.motion.moving import SPOILT, far_off, standing_out
from factorsfm.motion.readings import Reading, cost, flat, most_likely, points_alone, reversed_scene, solution_from
from factorsfm.motion.turning import turning_groups
from factorsfm.support.options import Options

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

# See `error_inflation` and `shared_error`: right solutions have 1 to 6, wrong ones 13 to 80, and right ones of long
# tracks 15, with 0.007 pixels in common. Wrong ones that lie nearest have 0.017.
_DOUBTFUL_INFLATION, _LEAST_SHARED_PX = 8.0, 0.01
_CLEARLY = 0.9  # of the cost of the solution from the incremental map, below which another one is preferred
_ROUGH = 1e-3  # relative decrease of the cost with which a try ends: the right one costs far less than the others
_ROUNDS = 3  # in which what moves is left out
_FITTING = 0.15  # of the observations, that a good start explains even if most of the tracks move by themselves
_MOST = 0.5  # of the image: where a solution leaves out more, it may be that of a thing before the scene
_CORE_TRACKS = 400  # on which the cameras are solved first
_CELLS, _CELL_TRACKS = (8, 5), 10  # across and down, and the tracks of each that take part at least


@dataclass(frozen=True, slots=True)
class CameraSolution(Reading):
    """All cameras on the core tracks.

    Attributes:
        kept, adjustment: see `Reading`; moving: how many points are left out because they move by themselves.
        turns: whether a camera that only turns explains them, through the lens that it has found.
        rest: what rests in the image while other things move, None where nothing does.
        rival: cost over that of the reading of the shot that comes next, if something else may be the scene; 0: none.
    """

    moving: int = 0
    turns: bool = False
    rest: Rest | None = None
    rival: float = 0.0


def best_solution(start: State, few: Observations, options: Options) -> CameraSolution:
    """The solution on the core tracks that fits best, without those that move by themselves or rest in the image.

    Large residuals, or residuals that neighbouring tracks and frames have in common, show that a solution is wrong: the
    incremental map may have been bent or depth-reversed beyond repair. Other starts are tried then. (The error of a
    single track may well persist for many frames: it slides along an edge.)
    """
    everything = CameraSolution(np.arange(len(start.bearing)), solution_from(start, few, options.polish))
    others = _without_resting(everything, start, few, options)
    if others is None:
        return _best(everything.adjustment, start, few, options)
    if is_doubtful(others.adjustment, options):  # beside more that moves, what rests may be the scene
        found = _of_one_scene(everything, start, few, options)
        if found is not everything:
            return found
    kept, count = others.kept, len(start.bearing)
    logger.info("%d of %d points do not move in the image and are left out", count - len(kept), count)
    found = _best(others.adjustment, start.of(kept), others.adjustment.observations, options)
    return replace(found, kept=kept[found.kept])


def _without_resting(everything: Reading, start: State, few: Observations, options: Options) -> Reading | None:
    """The solution without the points that rest in the image; None where these are none, or fit the others."""
    static = resting(few)
    if not static.any():
        return None
    others = np.nonzero(~static)[0]
    alone = solution_from(start.of(others), few.of(others), options.polish)
    return Reading(others, alone) if contradicts(everything.adjustment, alone, ~static) else None


def _best(solved: BundleAdjustment, start: State, few: Observations, options: Options) -> CameraSolution:
    """The best one of the solution from the start, one for each thing that may be the scene, and from other starts."""
    found = _without_moving(solved, options)
    if is_doubtful(found.adjustment, options) or _share_left_out(found, few) > _MOST:
        logger.info("the solution does not fit (%.2f px), trying what may be the scene", found.adjustment.sigma)
        found = _of_one_scene(found, start, few, options)
    if not is_doubtful(found.adjustment, options):
        return found
    logger.info("the solution does not fit (%.2f px), trying other starts", found.adjustment.sigma)
    known, rough = found, _roughly(options)
    for other in (start, flat(start, few, rough.polish)):
        found = _better(found, on_what_fits(other, few, rough), few)
    best = found.adjustment
    mirrored = solution_from(reversed_scene(best.state), best.observations, rough.polish)
    return _converged(_better(found, replace(found, adjustment=mirrored), few), known, options)


def _roughly(options: Options) -> Options:
    return replace(options, polish=replace(options.polish, tolerance=_ROUGH))


def _share_left_out(found: CameraSolution, few: Observations) -> float:
    """Share of the image that a solution leaves out."""
    return float(np.average(~np.isin(few.point, found.kept), weights=image_weights(few)))


def _converged(found: CameraSolution, known: CameraSolution, options: Options) -> CameraSolution:
    """A solution that was found roughly, unless it is the known one."""
    if found is known:
        return found
    rough = found.adjustment
    return replace(found, adjustment=solution_from(rough.state, rough.observations, options.polish))


def is_doubtful(solved: BundleAdjustment, options: Options) -> bool:
    """Whether the residuals say that a solution is wrong: they are large, or neighbours have them in common."""
    if solved.sigma > options.polish.doubtful_px:
        return True
    return solved.error_inflation() > _DOUBTFUL_INFLATION and solved.shared_error() > _LEAST_SHARED_PX


def _of_one_scene(known: CameraSolution, start: State, few: Observations, options: Options) -> CameraSolution:
    """The solution on what the start explains, or on a group that turns together, where it refutes the known one."""
    solutions, rough = [known], _roughly(options)
    if groups := turning_groups(few, start.normalized(few), float(np.median(start.focal))):
        solutions.append(on_what_fits(start, few, rough, _FITTING))
    for group in groups:
        reading = from_group(group, start, few, rough.polish)
        found = _without_moving(reading.adjustment, rough)
        moving = found.moving + len(start.bearing) - len(reading.kept)
        solutions.append(replace(found, kept=reading.kept[found.kept], moving=moving))
    best, rival = most_likely(solutions, few)
    return _converged(replace(solutions[best], rival=rival), known, options) if best else known


def on_what_fits(start: State, few: Observations, options: Options, share: float = 0.5) -> CameraSolution:
    """Converged from a start on the points that its cameras explain: what does not fit might lead away from it.

    Args:
        share: of the observations, those that the start explains at least.
    """
    points = points_alone(start, few, 1.0, options.polish)
    sigma = coordinate_sigma(points.reprojection_errors(), share)
    moves = far_off(BundleAdjustment(points.state, few, options.polish, ErrorModel(sigma)))
    others = np.nonzero(~moves)[0]
    found = _without_moving(solution_from(start.of(others), few.of(others), options.polish), options)
    return replace(found, kept=others[found.kept], moving=found.moving + int(moves.sum()))


def _without_moving(solved: BundleAdjustment, options: Options) -> CameraSolution:
    """The solution without what moves by itself, as far as that spoils it."""
    count = len(solved.state.bearing)
    kept = np.arange(count)
    for _ in range(_ROUNDS):
        moves = standing_out(solved)
        if not moves.any():
            break
        others = np.nonzero(~moves)[0]
        alone = solution_from(solved.state.of(others), solved.observations.of(others), options.polish)
        if not contradicts(solved, alone, ~moves, SPOILT):
            break
        logger.info("%d of %d points move by themselves and are left out", moves.sum(), len(moves))
        kept, solved = kept[others], alone
    return CameraSolution(kept, solved, count - len(kept))


def _better(known: CameraSolution, other: CameraSolution, few: Observations) -> CameraSolution:
    """The other solution where it fits clearly better, judged with the same noise: a median alone may be chance.

    With the smaller of both: to a solution that is wrong everywhere, what the right one leaves out is no worse.
    """
    sigma = min(known.adjustment.sigma, other.adjustment.sigma)
    known_cost, other_cost = (cost(solution, few, sigma) for solution in (known, other))
    return other if other_cost < _CLEARLY * known_cost else known


def core_tracks(observations: Observations, frames: int) -> Index:
    """Points of the longest tracks, with enough of them in each of the frames and in every part of the image.

    What follows the camera has the longest tracks, and the scene behind it is seen at the rim.
    """
    length = np.bincount(observations.point)
    order = np.argsort(-length, kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    chosen = rank < _CORE_TRACKS
    by_frame = np.lexsort((rank[observations.point], observations.frame))
    first = np.searchsorted(observations.frame[by_frame], np.arange(frames))
    place = np.arange(len(by_frame)) - first[observations.frame[by_frame]]
    chosen[observations.point[by_frame[place < _CORE_TRACKS // 3]]] = True
    core = np.nonzero(chosen)[0]
    return np.union1d(core, _everywhere(observations, _CELL_TRACKS))


def _everywhere(observations: Observations, count: int) -> Index:
    """Points in every part of the image, those seen there longest, for the lens.

    The longest tracks of a pan cross the middle of the image and miss its rim.
    """
    o = observations
    pairs, seen = np.unique(np.stack([image_cells(o.pixels, *_CELLS), o.point], 1), axis=0, return_counts=True)
    cell, point = pairs[np.lexsort((-seen, pairs[:, 0]))].T
    place = np.arange(len(cell)) - np.searchsorted(cell, cell)
    return np.unique(point[place < count])
