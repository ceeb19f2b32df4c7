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
from factorsfm.adjustment.residuals import cauchy

_SIGMAS = 10.0  # of an observation: a typical error beyond is not one of tracking
_SPREADS = 3.0  # robust standard deviations of the logarithms of the points' errors, beyond which one stands out
_LEAST, _LEAST_SHARE = 8, 0.02  # points: fewer do no harm
# Of the cost of the others' observations, if they are explained alone. Where nothing moves, it is 0.998 and more of it;
# beside people 0.93 to 0.97.
SPOILT = 0.98


def standing_out(adjustment: BundleAdjustment) -> NDArray[np.bool_]:
    """(n,) which points a solution does not explain at all; none where they are too few to do harm."""
    typical = np.sqrt(adjustment.observations.mean_by_point(adjustment.reprojection_errors() ** 2))
    size = np.log(typical + 1e-6)
    center = np.median(size)
    spread = 1.4826 * np.median(np.abs(size - center))
    found = (typical > _SIGMAS * adjustment.sigma) & (size > center + _SPREADS * spread)
    return np.asarray(found & (found.sum() >= max(_LEAST, _LEAST_SHARE * len(found))))


def bounded_cost(adjustment: BundleAdjustment, sigma: float, observations: int) -> float:
    """Robust cost in which no observation, and none that the solution leaves out, costs more than one that stands out.

    Solutions that explain different points are compared by it: what moves by itself costs the right one no more than
    what it leaves out.

    Args:
        sigma: of a coordinate (pixels), the same for all that are compared; observations: how many there are with
            those of the points left out.
    """
    kernel = adjustment.options.kernel
    most = float(cauchy(np.array([[_SIGMAS, 0.0]]), kernel)[0][0])
    costs = np.minimum(cauchy(adjustment.reprojection_vectors() / sigma, kernel)[0], most)
    return float(costs.sum()) + most * (observations - len(costs))
