"""What is laid over the images: captions, logos and time codes, which stay where they are while the scene moves.

In a shot with little parallax they are more than outliers: a scene that is flat, before which something near moves with
the camera, explains them and leaves only the little parallax unexplained. But not everything that rests in the image
is an overlay: so do the far background of a sideways move, and the point that a camera moves towards. So what rests is
only suspected, and left out where it contradicts the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.residuals import cauchy

_MOVED_PX = 2.0  # typical displacement of the others, from which something may be said to rest ...
_RESTS = 0.15  # ... and the share of it by which that may seem to move: its surroundings are in its window
_LEAST, _LEAST_SHARE = 8, 0.08  # points: fewer do no harm
CONTRADICTS = 0.95  # of the cost of the others' observations, if they are explained alone


def resting(observations: Observations) -> NDArray[np.bool_]:
    """(n,) which points rest in the image while what else is seen moves; none where they are too few to do harm."""
    o = observations
    start = o.first
    first, last = o.frame[start], o.frame[np.append(start[1:], len(o.frame)) - 1]
    moved = np.linalg.norm(o.pixels - o.pixels[start[o.point]], axis=1)
    reach = np.maximum.reduceat(moved, start)
    expected = np.zeros(len(start))
    suspects = np.nonzero(reach < _RESTS * reach.max())[0]
    least = max(_LEAST, _LEAST_SHARE * len(start))
    rows = np.argsort(o.frame, kind="stable")
    by_frame = np.split(rows, np.searchsorted(o.frame[rows], np.arange(1, last.max() + 1)))
    for frame in np.unique(first[suspects]).tolist() if len(suspects) >= least else ():
        seen = np.full((len(start), 2), np.nan)
        seen[o.point[by_frame[frame]]] = o.pixels[by_frame[frame]]
        born = suspects[first[suspects] == frame]
        end = int(last[born].max())
        for later in sorted({min(frame + 2**k, end) for k in range((end - frame).bit_length() + 1)}):
            there = by_frame[later]
            shift = np.linalg.norm(o.pixels[there] - seen[o.point[there]], axis=1)
            shift = shift[np.isfinite(shift)]
            lasting = born[last[born] >= later]
            if len(shift):
                expected[lasting] = np.maximum(expected[lasting], np.median(shift))
    found = (expected > _MOVED_PX) & (reach < _RESTS * expected)
    return np.asarray(found & (found.sum() >= least))


def contradicts(
    together: BundleAdjustment, alone: BundleAdjustment, kept: NDArray[np.bool_], below: float = CONTRADICTS
) -> bool:
    """Whether what is suspected spoils the solution of the others.

    Args:
        together: solved with all points; alone: with the `kept` ones only.
        below: share of the cost of the others that they must have without it.
    """
    residual = alone.reprojection_vectors()
    sigma = coordinate_sigma(np.linalg.norm(residual, axis=1))
    spoilt = together.reprojection_vectors()[kept[together.observations.point]]
    cost, spoilt_cost = (float(cauchy(r / sigma, alone.options.kernel)[0].sum()) for r in (residual, spoilt))
    return cost < below * spoilt_cost
