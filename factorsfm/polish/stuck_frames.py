"""Cameras that are stuck in a minimum of their own, away from the path of the others.

The first image of a map, or a damaged one, may have been registered where hardly anything held it. The joint solution
carries the others on, and that camera with a few wrong tracks only, which then seem to fit.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX
from factorsfm.adjustment.residuals import cauchy
from factorsfm.adjustment.state import State
from factorsfm.mapping.registration import register_image, residuals
from factorsfm.motion.readings import solution_from
from factorsfm.support.options import Options

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_JUMPS = 8.0  # times the median distance of a camera from the way between its neighbours, beyond which one is looked at
_BETTER = 0.8  # of the cost of its observations, below which another pose is preferred


def freed(solved: BundleAdjustment, times: Index, options: Options) -> BundleAdjustment:
    """The solution in which no camera beside the path fits better from where its neighbours are.

    Args:
        times: (k,) positions of the frames in the shot, ascending.
    """
    state, o = solved.state, solved.observations
    beside = _beside_the_path(state, times)
    on_path = np.setdiff1d(np.arange(len(times)), beside)
    if not len(beside) or not len(on_path):
        return solved
    rotation, translation, sigma = state.rotation.copy(), state.translation.copy(), max(solved.sigma, SMALLEST_SIGMA_PX)
    by_frame, xy, moved = o.rows_by_frame(len(times)), state.normalized(o), []
    for row in beside.tolist():
        mine, focal = by_frame[row], float(state.focal[row])
        if row == state.world or len(mine) < options.mapper.min_inliers:
            continue
        points, seen = state.points[o.point[mine]], xy[mine]
        near = on_path[np.argmin(np.abs(on_path - row))]
        found = register_image(
            points, seen, state.rotation[near], state.translation[near],
            focal=focal, sigma=sigma, inlier_px=options.mapper.inlier_px,
        )  # fmt: skip
        before, after = (
            _cost(residuals(points, seen, turn, shift, focal) / sigma, solved.options.kernel)
            for turn, shift in ((rotation[row], translation[row]), (found.rotation, found.translation))
        )
        if after < _BETTER * before:
            rotation[row], translation[row] = found.rotation, found.translation
            moved.append(row)
    if not moved:
        return solved
    logger.info("frames %s fit better beside their neighbours", [int(times[row]) for row in moved])
    return solution_from(replace(state, rotation=rotation, translation=translation), o, options.polish)


def _beside_the_path(state: State, times: Index) -> Index:
    """Frames whose camera is far from the way of its neighbours, as the distances of the others go."""
    if len(times) < 5:  # their median would be one of those that are looked at
        return np.zeros(0, np.int64)
    center = -np.einsum("kji,kj->ki", state.rotation, state.translation)
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    between = np.linalg.norm(center[1:-1] - (1.0 - share) * center[:-2] - share * center[2:], axis=1)
    # The first and the last camera are compared with where the two next to them lead.
    away = np.concatenate([between[:1] / (1.0 - share[0]), between, between[-1:] / share[-1]])
    return np.flatnonzero(away > _JUMPS * np.median(between))


def _cost(errors: Array, kernel: float) -> float:
    """Robust cost of errors in standard deviations; those behind the camera are infinite, and cost much."""
    return float(cauchy(np.minimum(errors, 1e6)[:, None], kernel)[0].sum())
