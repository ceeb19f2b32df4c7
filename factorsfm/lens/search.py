"""Where the estimate of a lens starts: a search over fields of view, with and without distortion, on a few frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Known, LensPrior
from factorsfm.adjustment.state import State
from factorsfm.lens.lens import Lens, through
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FIELDS_OF_VIEW = np.radians(np.geomspace(20.0, 100.0, 8))  # across the longer side of the area that the tracks fill
_SEARCH_FRAMES, _SEARCH_ITERATIONS, _PARABOLAS = 24, 15, 3
# Powers of the focal length with which a shape displaces the same pixels as far.
_SHAPE_POWERS = np.array([2.0, 4.0, -1.0, -1.0, 0.0, 0.0])


def search_lens(
    adjustment: BundleAdjustment, options: PolishOptions, sigmas: Array | None = None
) -> tuple[Lens, float]:
    """The lens of a solution, its focal lengths times the factor with which a few frames fit best, and their cost.

    Candidates, then parabolas around the best.

    Args:
        sigmas: (6,) prior standard deviations of the shape around that of the solution; None: it is constant.
    """
    guess = Lens.of(adjustment.state)
    _, state, few = some_frames(adjustment.state, adjustment.observations)
    options = replace(options, iterations=_SEARCH_ITERATIONS, tolerance=1e-3)
    known = Known(lens=None if sigmas is None else LensPrior(guess.shape, sigmas))

    def fit(near: State, factor: float) -> tuple[float, State]:
        focal = factor * guess.focal
        ratio = float(focal[0] / np.exp(near.log_focal[0])) if sigmas is not None else 1.0
        start = replace(through(near, focal), lens=near.lens * ratio**_SHAPE_POWERS)  # the same pixels move as far
        if not np.isfinite(start.normalized(few)).all():  # the lens has no ray for some pixels
            return np.inf, near
        problem = BundleAdjustment(start, few, options, ErrorModel(adjustment.sigma), known=known)
        problem.solve()
        return problem.cost(), problem.state

    width = float(np.ptp(state.normalized(few), axis=0).max())
    candidates = np.sort(0.5 * width / np.tan(_FIELDS_OF_VIEW / 2))
    fits = {1.0: fit(state, 1.0)}
    for side in (candidates[candidates > 1.0], candidates[candidates < 1.0][::-1]):
        near = fits[1.0][1]
        for factor in side.tolist():
            fits[factor] = fit(near, factor)
            near = fits[factor][1]
    for _ in range(_PARABOLAS):
        factors = sorted(fits)
        best = min(range(len(factors)), key=lambda i: fits[factors[i]][0])
        around = factors[max(best - 1, 0) : best + 2]
        costs = [fits[f][0] for f in around]
        if len(around) < 3 or not np.isfinite(costs).all():
            break
        x = np.log(np.array(around) / around[1])
        curvature, slope, _ = np.polyfit(x, costs, 2)
        factor = around[1] * float(np.exp(np.clip(-0.5 * slope / curvature, 0.5 * x[0], 0.5 * x[2])))
        fits[factor] = fit(fits[around[1]][1], factor)
    factor = min(fits, key=lambda f: fits[f][0])
    cost, found = fits[factor]
    return Lens(factor * guess.focal, found.lens), cost


def some_frames(state: State, observations: Observations) -> tuple[Index, State, Observations]:
    """Few frames, evenly spread, that of the world among them: their rows, and the points that two of them see."""
    count = len(state.rotation)
    frames = np.unique([*np.linspace(0, count - 1, min(count, _SEARCH_FRAMES)).astype(int), state.world])
    keep = np.isin(observations.frame, frames)
    seen = np.bincount(observations.point[keep], minlength=len(state.bearing)) >= 2
    keep &= seen[observations.point]
    points = np.flatnonzero(seen)
    part = replace(
        state.of(points),
        rotation=state.rotation[frames],
        translation=state.translation[frames],
        group=state.group[frames],
        world=int(np.searchsorted(frames, state.world)),
    )
    frame, point = observations.frame[keep], observations.point[keep]
    return (
        frames,
        part,
        observations.at(keep, frame=np.searchsorted(frames, frame), point=np.searchsorted(points, point)),
    )
