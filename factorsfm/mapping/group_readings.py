"""The reading of a shot in which a group of points that turn together is the scene, or a part of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.mapping.all_points import with_all_points
from factorsfm.motion.moving import as_exact
from factorsfm.motion.readings import Reading, flat, points_alone, solution_from
from factorsfm.support.options import PolishOptions


def from_group(group: NDArray[np.bool_], start: State, observations: Observations, options: PolishOptions) -> Reading:
    """Converged on a group from cameras that only turn, and then on all points that are as exact as the group.

    Args:
        group: (n,) which points; each frame sees some of them. start: rotations, and a lens.
    """
    rows = np.flatnonzero(group)
    part = observations.of(rows)
    alone = solution_from(flat(start.of(rows), part, options), part, options)
    everything = with_all_points(alone.state, alone.state, observations, rows)
    points = points_alone(everything, observations, alone.sigma, options)
    kept = np.flatnonzero(as_exact(points, group))
    return Reading(kept, solution_from(points.state.of(kept), observations.of(kept), options))
