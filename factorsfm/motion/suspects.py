"""What a network takes for people: suspected, and taken back where it agrees with the scene.

A statue, a poster and a parked car look like what moves, and a person may sit still. What moves shows itself by errors
under poses to which it did not contribute. A single short track may fit by chance, so its neighbours must fit, too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.motion.moving import center_and_spread, log_errors
from factorsfm.motion.neighbours import places, share_nearby

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# More than half of the neighbours must be as exact as most of the scene: within a robust standard deviation of the
# logarithms of its errors, where 84 % of its own tracks are. One more that is not is counted: a few may fit by chance.
# On rendered shots 83 to 90 % of half an image that is masked by mistake come back so, and 14 % of an actor who hardly
# moves, where the cameras are as exact as without him.
_EXACT, _SHARE = 1.0, 0.5
_LEAST_SPREAD = 0.1  # of the logarithms of the scene's errors


def agreeing(observations: Observations, errors: Array, suspected: Flags) -> Flags:
    """(n,) which points agree with the scene; all that are not suspected count as the scene.

    Args:
        errors: (m,) reprojection errors of the observations, under poses from the scene alone.
        suspected: (n,) which points are.
    """
    if not suspected.any() or suspected.all():
        return ~suspected
    size = log_errors(observations, errors)
    center, spread = center_and_spread(size[~suspected])
    exact = size[suspected] < center + _EXACT * max(spread, _LEAST_SPREAD)
    result = ~suspected
    result[suspected] = exact & (share_nearby(places(observations)[suspected], exact) > _SHARE)
    return result
