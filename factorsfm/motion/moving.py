"""Things that move by themselves: tracks that the camera's motion does not explain, and that bend it none the less.

A robust kernel bounds the pull of one observation, not of a person: its tracks agree with each other, are as exact as
those of the scene, and where the camera hardly translates they alone seem to say how it does. So tracks that stand out
are suspected, and left out as a whole where the rest fits better without them. Single tracks that slide along an edge
stand out, too, but nothing fits better without them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.residuals import cauchy
from factorsfm.motion.neighbours import places, share_nearby

_SIGMAS = 10.0  # of an observation: a typical error beyond is not one of tracking
_SPREADS = 3.0  # robust standard deviations of the logarithms of the points' errors, beyond which one stands out
_LEAST_SPREAD = 0.2  # of these logarithms, however alike the points are
_LEAST, _LEAST_SHARE = 8, 0.02  # points: fewer do no harm
# Of the cost of the others' observations, if they are explained alone. Where nothing moves, it is 0.998 and more of it;
# beside people 0.93 to 0.97.
SPOILT = 0.98
# Of the neighbours of a track inside of a thing, which stand out, too, if one more did not. Walkers have 25 to 400 such
# tracks; where nothing moves, tracks that slide in the dark or in reflections are two at most.
_INSIDE = 0.8


def standing_out(adjustment: BundleAdjustment) -> NDArray[np.bool_]:
    """(n,) which points a solution does not explain at all; none where they are too few to do harm."""
    size = log_errors(adjustment.observations, adjustment.reprojection_errors())
    found = _beyond(size, size, adjustment.sigma)
    return np.asarray(found & (found.sum() >= max(_LEAST, _LEAST_SHARE * len(found))))


def far_off(adjustment: BundleAdjustment) -> NDArray[np.bool_]:
    """(n,) which points cameras do not explain at all that are right for most of the others.

    However many they are: with a third of the points on something that moves, the errors of all are widely spread.
    """
    size = log_errors(adjustment.observations, adjustment.reprojection_errors())
    return _beyond_tracking(size, adjustment.sigma)


def moving_together(
    observations: Observations,
    errors: NDArray[np.float64],
    sigma: float,
    *,
    rests_on: NDArray[np.int64],
    left_out: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """(n,) which points move by themselves: a solution does not explain them at all, nor what is around them.

    What slides along an edge stands out alone, a thing with all of its tracks: some are amid others that stand out,
    and the rest beside these.

    Args:
        errors: (m,) of the observations under cameras that rest on some of the points, pixels.
        sigma: of a coordinate of what they rest on, pixels.
        rests_on: these points; left_out: points without which they fit better.
    """
    size = log_errors(observations, errors)
    found = _beyond(size, size[rests_on], sigma)
    if not found.any():
        return found
    where = places(observations)
    inside = found.copy()
    inside[found] = share_nearby(where, found, found) > _INSIDE
    inside[left_out] = found[left_out]
    found[found] = share_nearby(where, inside, found) > 0.0
    return np.asarray(found & (inside.sum() >= _LEAST))


def _beyond(size: NDArray[np.float64], usual: NDArray[np.float64], sigma: float) -> NDArray[np.bool_]:
    """Which logarithms of errors are beyond those of tracking, and beyond the usual ones."""
    center, spread = center_and_spread(usual)
    return _beyond_tracking(size, sigma) & (size > center + _SPREADS * spread)


def _beyond_tracking(size: NDArray[np.float64], sigma: float) -> NDArray[np.bool_]:
    return np.asarray(size > np.log(_SIGMAS * sigma))


def as_exact(adjustment: BundleAdjustment, members: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) which points are as exact as some of them are, and these.

    Args:
        adjustment: of all points, with cameras from the members alone; members: (n,).
    """
    size = log_errors(adjustment.observations, adjustment.reprojection_errors())
    center, spread = center_and_spread(size[members])
    return np.asarray(members | (size < center + _SPREADS * max(spread, _LEAST_SPREAD)))


def log_errors(observations: Observations, errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) logarithms of the typical errors of the points, from those of the observations (m,), pixels."""
    return np.asarray(np.log(np.sqrt(observations.mean_by_point(errors**2)) + 1e-6))


def center_and_spread(values: NDArray[np.float64]) -> tuple[float, float]:
    """Median, and the robust standard deviation around it."""
    center = float(np.median(values))
    return center, 1.4826 * float(np.median(np.abs(values - center)))


def bounded_costs(adjustment: BundleAdjustment, sigma: float) -> NDArray[np.float64]:
    """(m,) robust costs of the observations, none larger than that of one that stands out.

    Solutions that explain different points are compared by them: what moves by itself costs the right one no more than
    what it leaves out.

    Args:
        sigma: of a coordinate (pixels), the same for all that are compared.
    """
    costs = cauchy(adjustment.reprojection_vectors() / sigma, adjustment.options.kernel)[0]
    return np.asarray(np.minimum(costs, largest_cost(adjustment.options.kernel)))


def largest_cost(kernel: float) -> float:
    """Of an observation that stands out, and of one that a solution leaves out."""
    return float(cauchy(np.array([[_SIGMAS, 0.0]]), kernel)[0][0])
