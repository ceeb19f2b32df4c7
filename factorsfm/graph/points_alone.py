"""Points under known cameras, scales and shifts: the paper's equation 3, solved by GTSAM.

With all else constant a depth-consistency factor is on the landmark alone, too: the projection into the virtual camera
of `native_depth_factor`, which then is a constant like the real one.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.adjustment.state import State
from factorsfm.graph.factors import (
    constant_projection_factor,
    depth_noise,
    landmark_prior,
    lens_of,
    native_affine,
    pixel_noise,
    pose_from_camera,
    virtual_offset,
)
from factorsfm.graph.live_isam import LANDMARK_SIGMA

Array = NDArray[np.float64]

_STEPS = 20
_FARTHEST = 1e-3  # smallest inverse distance at the start, in units of the median


def solve_points(state: State, observations: Observations, sigma: float, prior: PriorObservations) -> State:
    """The state with the points that fit their observations and the depth prior best, all else held.

    Args:
        observations: of all points; sigma: standard deviation of their coordinates, pixels.
        prior: values whose scales and shifts are those of the state.
    """
    graph, values, noise = gtsam.NonlinearFactorGraph(), gtsam.Values(), pixel_noise(sigma)
    poses = [pose_from_camera(turn, shift) for turn, shift in zip(state.rotation, state.translation, strict=True)]
    lenses = [lens_of(focal) for focal in state.focal.tolist()]
    cameras = [gtsam.PinholePoseCal3_S2(pose, lens) for pose, lens in zip(poses, lenses, strict=True)]
    pixels = state.focal[observations.frame, None] * state.normalized(observations)
    for i, j, seen in zip(observations.frame.tolist(), observations.point.tolist(), pixels, strict=True):
        graph.add(constant_projection_factor(cameras[i], seen, noise, L(j)))
    virtual = {
        image: gtsam.PinholePoseCal3_S2(
            poses[frame].compose(virtual_offset()), native_affine(float(state.scale[image]), float(state.shift[image]))
        )
        for image, frame in {*zip(prior.image.tolist(), prior.frame.tolist(), strict=True)}
    }
    measured = zip(
        prior.image.tolist(), prior.point.tolist(), prior.inverse_depth.tolist(), prior.sigma.tolist(), strict=True
    )
    for image, j, value, std in measured:
        graph.add(constant_projection_factor(virtual[image], np.array([value, 0.0]), depth_noise(std), L(j)))
    nearest = _FARTHEST * float(np.median(np.abs(state.inverse_distance)))
    start = state.bearing / np.maximum(state.inverse_distance, nearest)[:, None]
    for j, point in enumerate(start):
        values.insert(L(j), point)
        graph.add(landmark_prior(L(j), point, LANDMARK_SIGMA * float(np.linalg.norm(point))))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_STEPS)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    points = np.array([solved.atPoint3(L(j)) for j in range(len(start))])
    distance = np.linalg.norm(points, axis=1)
    return replace(state, bearing=points / distance[:, None], inverse_distance=1.0 / distance)
