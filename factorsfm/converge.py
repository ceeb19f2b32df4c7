"""All cameras on the longest tracks: where the polish starts, and where a bent or reversed map is recovered."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.burn_ins import contradicts, resting
from factorsfm.noise import FIRST_SIGMA_PX, coordinate_sigma, temporal_inflation
from factorsfm.options import Options, PolishOptions
from factorsfm.problem import Observations, State
from factorsfm.refinement import BundleAdjustment

Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_DOUBTFUL_INFLATION = 3.5  # sound solutions have 1 to 4; a doubt costs no more than time
_CLEARLY = 0.9  # of the cost of the incremental map's solution, at which another start is preferred
_CORE_TRACKS = 400  # tracks with which the cameras converge first


def converge_cameras(
    state: State, observations: Observations, options: Options
) -> tuple[Index, Observations, BundleAdjustment]:
    """All cameras on the core tracks: the points, their observations, the solution.

    Residuals that are large, or repeat themselves for many frames, say that the solution is not one: the incremental
    map may have been bent or depth-reversed beyond repair. Other starts are tried then, and the best fit is kept.
    """
    core = _core(observations, len(state.rotation), _CORE_TRACKS)
    few = observations.of(core)
    part = _points_of(state, core)
    best = _solve_core(part, few, options)
    kept = ~resting(few, float(np.median(state.focal)))
    if not kept.all():
        others = np.nonzero(kept)[0]
        alone = _solve_core(_points_of(part, others), few.of(others), options)
        if contradicts(best, alone, kept):
            logger.info("%d of %d points rest in the image and are left out", (~kept).sum(), len(kept))
            core, few, part, best = core[others], alone.observations, _points_of(part, others), alone
    if (
        best.sigma > options.polish.doubtful_px
        or temporal_inflation(best.reprojection_vectors(), few) > _DOUBTFUL_INFLATION
    ):
        logger.info("the solution does not fit (%.2f px), trying other starts", best.sigma)
        best = _better(best, _solve_core(_flat(part, few, options.polish), few, options))
        best = _better(best, _solve_core(_reversed(best.state), few, options))
    return core, few, best


def _points_of(state: State, points: Index) -> State:
    return replace(state, bearing=state.bearing[points], inverse_distance=state.inverse_distance[points])


def _better(known: BundleAdjustment, other: BundleAdjustment) -> BundleAdjustment:
    """The other solution where it fits clearly better, at one scale of the errors: a median alone may be chance."""
    cost, other_cost = (
        BundleAdjustment(b.state, b.observations, b.options, sigma=known.sigma).cost() for b in (known, other)
    )
    return other if other_cost < _CLEARLY * cost else known


def _solve_core(part: State, few: Observations, options: Options) -> BundleAdjustment:
    """Converged from one start, first with a wide kernel."""
    o = options.polish
    errors = BundleAdjustment(part, few, o, sigma=1.0).reprojection_errors()
    sigma = max(FIRST_SIGMA_PX, coordinate_sigma(errors))
    adjustment = BundleAdjustment(part, few, replace(o, iterations=20, tolerance=1e-3), sigma=sigma)
    adjustment.solve()
    sigma = min(sigma, coordinate_sigma(adjustment.reprojection_errors()))
    adjustment = BundleAdjustment(adjustment.state, few, o, sigma=sigma)
    adjustment.solve()
    adjustment.state = in_front(adjustment.state)
    logger.debug("cameras: %d iterations, %.3f px", adjustment.iterations, sigma)
    adjustment.sigma = coordinate_sigma(adjustment.reprojection_errors())
    return adjustment


def _flat(part: State, few: Observations, options: PolishOptions) -> State:
    """Rotations alone, all points at one distance: a start that takes no side."""
    still = replace(
        part,
        translation=np.zeros_like(part.translation),
        inverse_distance=np.full(len(part.inverse_distance), float(np.median(part.inverse_distance))),
    )
    rotating = BundleAdjustment(still, few, replace(options, iterations=15), sigma=1.0, free_translation=False)
    return rotating.solve()


def in_front(part: State) -> State:
    """The scene before the cameras: with all inverse distances and translations negated, the images are the same."""
    if float(np.median(part.inverse_distance)) >= 0.0:
        return part
    return replace(part, translation=-part.translation, inverse_distance=-part.inverse_distance)


def _reversed(part: State) -> State:
    """Near and far exchanged and the motion turned round: in a narrow view almost the same images."""
    center = float(np.median(part.inverse_distance))
    inverse = np.clip(2.0 * center - part.inverse_distance, 0.05 * center, 4.0 * center)
    return replace(part, translation=-part.translation, inverse_distance=inverse)


def _core(observations: Observations, frames: int, count: int) -> Index:
    """Points that hold the cameras together: the longest tracks, but enough of them in every frame."""
    length = np.bincount(observations.point)
    order = np.argsort(-length, kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    chosen = rank < count
    by_frame = np.lexsort((rank[observations.point], observations.frame))
    first = np.searchsorted(observations.frame[by_frame], np.arange(frames))
    place = np.arange(len(by_frame)) - first[observations.frame[by_frame]]
    chosen[observations.point[by_frame[place < count // 3]]] = True
    return np.nonzero(chosen)[0]
