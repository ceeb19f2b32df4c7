"""Where the estimate of a lens starts: a search over fields of view, with and without distortion, on a few frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import DISTORTION
from factorsfm.adjustment.problem import ErrorModel, Free, Known, LensPrior
from factorsfm.adjustment.some_frames import on_some_frames, some_frames
from factorsfm.adjustment.state import State
from factorsfm.lens.lens import Lens, through
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]

_FIELDS_OF_VIEW = np.radians(np.geomspace(20.0, 100.0, 8))  # across the longer side of the area that the tracks fill
_ITERATIONS, _PARABOLAS = 15, 3
_ROUGH, _TOLERANCE = 1e-2, 1e-3  # relative decrease of the cost: of candidates, and where their best is looked for
_CLEARLY = 0.9  # of the cost of another lens, below which one is preferred to it
# Of the cost of the guess: with less of it, the cameras are solved through what is found. A twelfth more of the cost
# makes errors so alike among neighbours that the reading of the shot would be doubted, not the lens.
_BETTER = 0.98
_BENDS = 0.95  # of the cost without distortion: with less of it, some beside the best lens asks for a search with it
# Powers of the focal length with which a shape displaces the same pixels as far.
_SHAPE_POWERS = np.array([2.0, 4.0, -1.0, -1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class FoundLens:
    """Where the estimate of a lens starts.

    Attributes:
        guess: where the search started.
        straight: without free distortion; better: whether a few frames fit it better than the guess.
        bent: with free distortion, where that fits clearly better still.
    """

    guess: Lens
    straight: Lens
    better: bool
    bent: Lens | None


def found_lens(adjustment: BundleAdjustment, options: PolishOptions, sigmas: Array) -> FoundLens:
    """The lenses through which few frames of a solution, through a guess, fit best.

    Args:
        sigmas: (6,) prior standard deviations of the shape where it is free.
    """
    guess = Lens.of(adjustment.state)
    straight, cost = search_lens(adjustment, options)
    better, bent = cost < _BETTER * on_some_frames(adjustment).cost(), None
    if sigmas[DISTORTION].any() and _bends(straight, cost, adjustment, options, sigmas):
        state, bent_cost = search_lens(adjustment, options, sigmas)
        bent = Lens.of(state) if bent_cost < _CLEARLY * cost else None
    return FoundLens(guess, Lens.of(straight), better, bent)


def _bends(straight: State, cost: float, adjustment: BundleAdjustment, options: PolishOptions, sigmas: Array) -> bool:
    """Whether some distortion beside the best lens without it makes the few frames fit better."""
    _, _, few = some_frames(adjustment.state, adjustment.observations)
    free = BundleAdjustment(
        straight, few, replace(options, iterations=_ITERATIONS, tolerance=_TOLERANCE), ErrorModel(adjustment.sigma),
        free=Free(focal=True), known=Known(lens=LensPrior(straight.lens, sigmas)),
    )  # fmt: skip
    free.solve()
    return free.cost() < _BENDS * cost


def search_lens(
    adjustment: BundleAdjustment, options: PolishOptions, sigmas: Array | None = None
) -> tuple[State, float]:
    """A few frames of a solution with its focal lengths times the factor with which they fit best, and their cost.

    Candidates, then parabolas around the best.

    Args:
        sigmas: (6,) prior standard deviations of the shape around that of the solution; None: it is constant.
    """
    guess = Lens.of(adjustment.state)
    _, state, few = some_frames(adjustment.state, adjustment.observations)
    known = Known(lens=None if sigmas is None else LensPrior(guess.shape, sigmas))

    def fit(near: State, factor: float, tolerance: float = _ROUGH) -> tuple[float, State]:
        focal = factor * guess.focal
        ratio = float(focal[0] / np.exp(near.log_focal[0])) if sigmas is not None else 1.0
        start = replace(through(near, focal), lens=near.lens * ratio**_SHAPE_POWERS)  # the same pixels move as far
        if not np.isfinite(start.normalized(few)).all():  # the lens has no ray for some pixels
            return np.inf, near
        solver = replace(options, iterations=_ITERATIONS, tolerance=tolerance)
        problem = BundleAdjustment(start, few, solver, ErrorModel(adjustment.sigma), known=known)
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
        fits[factor] = fit(fits[around[1]][1], factor, _TOLERANCE)
    factor = min(fits, key=lambda f: fits[f][0])
    cost, found = fits[factor]
    return found, cost
