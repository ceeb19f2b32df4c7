"""All cameras on the longest tracks: where the polish starts, and where a bent or reversed map is recovered."""

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

_DOUBTFUL_INFLATION = 8.0  # of blocks of the image and of time; sound solutions have 1 to 6, false ones 13 to 80
_CLEARLY = 0.9  # of the cost of the incremental map's solution, at which another start is preferred
_SETTLED = 0.8  # of the scale that a solution assumed, below which its errors ask for another round
_CORE_TRACKS = 400  # tracks with which the cameras converge first
_CELLS, _CELL_TRACKS = (8, 5), 10  # across and down, and the tracks of each with which an unknown lens is estimated


def start_cameras(start: State, few: Observations, options: Options) -> tuple[Index, BundleAdjustment]:
    """All cameras on the core tracks: which points are kept, and the solution.

    Residuals that are large, or alike among neighbouring tracks and frames, say that the solution is not one: the
    incremental map may have been bent or depth-reversed beyond repair. Other starts are tried then, and the best fit
    is kept. (A single track may well repeat its error for many frames: it slides along what it follows.)
    """
    kept, best = np.arange(len(start.bearing)), converged(start, few, options)
    rests = resting(few)
    if rests.any():
        others = np.nonzero(~rests)[0]
        alone = converged(start.of(others), few.of(others), options)
        if contradicts(best, alone, ~rests):
            logger.info("%d of %d points rest in the image and are left out", rests.sum(), len(rests))
            kept, start, few, best = others, start.of(others), alone.observations, alone
    if best.sigma > options.polish.doubtful_px or best.error_inflation() > _DOUBTFUL_INFLATION:
        logger.info("the solution does not fit (%.2f px), trying other starts", best.sigma)
        best = _better(best, converged(_flat(start, few, options.polish), few, options))
        best = _better(best, converged(_reversed(best.state), few, options))
    return kept, best


def _better(known: BundleAdjustment, other: BundleAdjustment) -> BundleAdjustment:
    """The other solution where it fits clearly better, at one scale of the errors: a median alone may be chance."""
    cost, other_cost = (
        BundleAdjustment(b.state, b.observations, b.options, ErrorModel(known.sigma)).cost() for b in (known, other)
    )
    return other if other_cost < _CLEARLY * cost else known


def converged(part: State, few: Observations, options: Options) -> BundleAdjustment:
    """Converged from one start, first with a wide kernel."""
    o = options.polish
    errors = BundleAdjustment(part, few, o, ErrorModel(1.0)).reprojection_errors()
    sigma = max(FIRST_SIGMA_PX, coordinate_sigma(errors))
    adjustment = BundleAdjustment(part, few, replace(o, iterations=20, tolerance=1e-3), ErrorModel(sigma))
    adjustment.solve()
    iterations, measured = adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
    while True:
        # A wide kernel averages over outliers and lets go early: what it finds counts once the kernel fits the errors.
        sigma = min(sigma, measured)
        adjustment = BundleAdjustment(adjustment.state, few, o, ErrorModel(sigma))
        adjustment.solve()
        iterations, measured = iterations + adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
        if measured > _SETTLED * sigma:
            break
    logger.debug("cameras: %d iterations, %.3f px", iterations, measured)
    return BundleAdjustment(in_front(adjustment.state), few, o, ErrorModel(measured))


def _flat(part: State, few: Observations, options: PolishOptions) -> State:
    """Rotations alone, all points at one distance: a start that takes no side."""
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
    """The scene before the cameras: with all inverse distances and translations negated, the images are the same."""
    if float(np.median(part.inverse_distance)) >= 0.0:
        return part
    return replace(part, translation=-part.translation, inverse_distance=-part.inverse_distance)


def _reversed(part: State) -> State:
    """Near and far exchanged and the motion turned round: in a narrow view almost the same images."""
    center = float(np.median(part.inverse_distance))
    inverse = np.clip(2.0 * center - part.inverse_distance, 0.05 * center, 4.0 * center)
    return replace(part, translation=-part.translation, inverse_distance=inverse)


def core_tracks(observations: Observations, frames: int, *, everywhere: bool = False) -> Index:
    """Points that hold the cameras together: the longest tracks, but enough of them in every frame.

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
    """Points that show the lens in every part of the image: those seen there longest.

    The longest tracks of a pan cross its middle, and say little of its rim.
    """
    o = observations
    pairs, seen = np.unique(np.stack([image_cells(o.pixels, *_CELLS), o.point], 1), axis=0, return_counts=True)
    cell, point = pairs[np.lexsort((-seen, pairs[:, 0]))].T
    place = np.arange(len(cell)) - np.searchsorted(cell, cell)
    return np.unique(point[place < count])
