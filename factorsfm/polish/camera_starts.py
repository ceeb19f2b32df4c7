"""All cameras solved on the longest tracks, from several starts where the incremental map is bent or depth-reversed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, coordinate_sigma, image_cells
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.motion.at_rest import Rest
from factorsfm.motion.burn_ins import contradicts, resting
from factorsfm.motion.moving import SPOILT, bounded_cost, standing_out
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.rotations import exponential

Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_DOUBTFUL_INFLATION = 8.0  # see `error_inflation`; right solutions have 1 to 6, wrong ones 13 to 80
_CLEARLY = 0.9  # of the cost of the solution from the incremental map, below which another one is preferred
_SETTLED = 0.8  # of the assumed noise, below which the measured noise asks for another round
_ROUNDS = 3  # in which what moves is left out
_POINT_ITERATIONS = 4  # of the points alone, until they show what fits the cameras of a start
_CORE_TRACKS = 400  # on which the cameras are solved first
_CELLS, _CELL_TRACKS = (8, 5), 10  # across and down, and the tracks of each with which an unknown lens is estimated


@dataclass(frozen=True, slots=True)
class CameraSolution:
    """All cameras on the core tracks.

    Attributes:
        kept: which of the points it has; adjustment: converged over them; moving: how many are left out because they
            move by themselves.
        turns: whether a camera that only turns explains them, through the lens that it has found.
        rest: what rests in the image while other things move, None where nothing does.
    """

    kept: Index
    adjustment: BundleAdjustment
    moving: int = 0
    turns: bool = False
    rest: Rest | None = None


def best_solution(start: State, few: Observations, options: Options) -> CameraSolution:
    """The solution on the core tracks that fits best, without those that move by themselves or rest in the image.

    Large residuals, or residuals that neighbouring tracks and frames have in common, show that a solution is wrong: the
    incremental map may have been bent or depth-reversed beyond repair. Other starts are tried then. (The error of a
    single track may well persist for many frames: it slides along an edge.)
    """
    kept, best = np.arange(len(start.bearing)), solution_from(start, few, options)
    static = resting(few)
    if static.any():
        others = np.nonzero(~static)[0]
        alone = solution_from(start.of(others), few.of(others), options)
        if contradicts(best, alone, ~static):
            logger.info("%d of %d points do not move in the image and are left out", static.sum(), len(static))
            kept, start, few, best = others, start.of(others), alone.observations, alone
    found = _without_moving(best, options)
    best = found.adjustment
    if best.sigma > options.polish.doubtful_px or best.error_inflation() > _DOUBTFUL_INFLATION:
        logger.info("the solution does not fit (%.2f px), trying other starts", best.sigma)
        for other in (start, _flat(start, few, options.polish)):
            found = _better(found, on_what_fits(other, few, options), few)
        best = found.adjustment
        mirrored = solution_from(reversed_scene(best.state), best.observations, options)
        found = _better(found, replace(found, adjustment=mirrored), few)
    return replace(found, kept=kept[found.kept])


def on_what_fits(start: State, few: Observations, options: Options) -> CameraSolution:
    """Converged from a start on the points that its cameras explain: what does not fit might lead away from it."""
    points = BundleAdjustment(
        start, few, replace(options.polish, iterations=_POINT_ITERATIONS), ErrorModel(1.0), free=Free(cameras=False)
    )
    points.solve()
    sigma = coordinate_sigma(points.reprojection_errors())
    moves = standing_out(BundleAdjustment(points.state, few, options.polish, ErrorModel(sigma)))
    others = np.nonzero(~moves)[0]
    found = _without_moving(solution_from(start.of(others), few.of(others), options), options)
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
        alone = solution_from(solved.state.of(others), solved.observations.of(others), options)
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
    cost, other_cost = (bounded_cost(s.adjustment, sigma, len(few.frame)) for s in (known, other))
    return other if other_cost < _CLEARLY * cost else known


def solution_from(part: State, few: Observations, options: Options) -> BundleAdjustment:
    """Converged from one start: first with a wide kernel, then with one that fits the residuals."""
    o = options.polish
    errors = BundleAdjustment(part, few, o, ErrorModel(1.0)).reprojection_errors()
    sigma = max(FIRST_SIGMA_PX, coordinate_sigma(errors))
    adjustment = BundleAdjustment(part, few, replace(o, iterations=20, tolerance=1e-3), ErrorModel(sigma))
    adjustment.solve()
    iterations, measured = adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
    while True:
        # A wide kernel averages over outliers; the solution counts once the kernel fits the residuals.
        sigma = min(sigma, measured)
        adjustment = BundleAdjustment(adjustment.state, few, o, ErrorModel(sigma))
        adjustment.solve()
        iterations, measured = iterations + adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
        if measured > _SETTLED * sigma:
            break
    logger.debug("cameras: %d iterations, %.3f px", iterations, measured)
    return BundleAdjustment(in_front(adjustment.state), few, o, ErrorModel(measured))


def _flat(part: State, few: Observations, options: PolishOptions) -> State:
    """Rotations alone, all points at one distance: a start without any shape."""
    still = replace(
        part,
        translation=np.zeros_like(part.translation),
        inverse_distance=np.full(len(part.inverse_distance), float(np.median(part.inverse_distance))),
    )
    rotating = BundleAdjustment(
        still, few, replace(options, iterations=15), ErrorModel(1.0), free=Free(translation=False)
    )
    return rotating.solve()


def in_front(part: State) -> State:
    """The solution with its scene in front: negated inverse distances and translations show the same images."""
    if float(np.median(part.inverse_distance)) >= 0.0:
        return part
    return replace(part, translation=-part.translation, inverse_distance=-part.inverse_distance)


def reversed_scene(part: State) -> State:
    """Near and far exchanged and the motion reversed: in a narrow view the images are almost the same.

    Each camera also turns, by twice the angle under which its way is seen from the middle of the scene: what was seen
    there stays where it was. Without that, the way back to the first scene is shorter than that to its reversal.
    """
    center = float(np.median(part.inverse_distance))
    inverse = np.clip(2.0 * center - part.inverse_distance, 0.05 * center, 4.0 * center)
    x, y, z = 2.0 * center * part.translation.T
    turn = exponential(np.stack([-y, x, np.zeros_like(x)], 1) / np.maximum(1.0 + z, 0.5)[:, None])
    return replace(part, rotation=turn @ part.rotation, translation=-part.translation, inverse_distance=inverse)


def core_tracks(observations: Observations, frames: int, *, everywhere: bool = False) -> Index:
    """Points of the longest tracks, with enough of them in every frame.

    Args:
        frames: how many there are; everywhere: enough of them in every part of the image, too, for the lens.
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
    return np.union1d(core, _everywhere(observations, _CELL_TRACKS)) if everywhere else core


def _everywhere(observations: Observations, count: int) -> Index:
    """Points in every part of the image, those seen there longest, for the lens.

    The longest tracks of a pan cross the middle of the image and miss its rim.
    """
    o = observations
    pairs, seen = np.unique(np.stack([image_cells(o.pixels, *_CELLS), o.point], 1), axis=0, return_counts=True)
    cell, point = pairs[np.lexsort((-seen, pairs[:, 0]))].T
    place = np.arange(len(cell)) - np.searchsorted(cell, cell)
    return np.unique(point[place < count])
