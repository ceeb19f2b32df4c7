"""All cameras solved on the longest tracks, from several starts where the incremental map is bent or depth-reversed."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, coordinate_sigma, image_cells
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.motion.burn_ins import contradicts, resting
from factorsfm.support.options import Options, PolishOptions

Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_DOUBTFUL_INFLATION = 8.0  # see `error_inflation`; right solutions have 1 to 6, wrong ones 13 to 80
_CLEARLY = 0.9  # of the cost of the solution from the incremental map, below which another one is preferred
_SETTLED = 0.8  # of the assumed noise, below which the measured noise asks for another round
_CORE_TRACKS = 400  # on which the cameras are solved first
_CELLS, _CELL_TRACKS = (8, 5), 10  # across and down, and the tracks of each with which an unknown lens is estimated


def best_solution(start: State, few: Observations, options: Options) -> tuple[Index, BundleAdjustment]:
    """All cameras on the core tracks: which points are kept, and the solution that fits best.

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
    if best.sigma > options.polish.doubtful_px or best.error_inflation() > _DOUBTFUL_INFLATION:
        logger.info("the solution does not fit (%.2f px), trying other starts", best.sigma)
        best = _better(best, solution_from(_flat(start, few, options.polish), few, options))
        best = _better(best, solution_from(_reversed(best.state), few, options))
    return kept, best


def _better(known: BundleAdjustment, other: BundleAdjustment) -> BundleAdjustment:
    """The other solution where it fits clearly better, judged with the same noise: a median alone may be chance."""
    cost, other_cost = (
        BundleAdjustment(b.state, b.observations, b.options, ErrorModel(known.sigma)).cost() for b in (known, other)
    )
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


def _reversed(part: State) -> State:
    """Near and far exchanged and the motion reversed: in a narrow view the images are almost the same."""
    center = float(np.median(part.inverse_distance))
    inverse = np.clip(2.0 * center - part.inverse_distance, 0.05 * center, 4.0 * center)
    return replace(part, translation=-part.translation, inverse_distance=inverse)


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
