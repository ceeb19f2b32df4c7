"""The pose and the affine of one image, its points held fixed: the paper's equation 2, solved by GTSAM."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.factors import camera_from_pose, pose_from_camera

Array = NDArray[np.float64]

POSE, AFFINE = gtsam.symbol("x", 0), gtsam.symbol("a", 0)  # the keys of the two variables


def solve_pose_and_affine(
    factors: Sequence[gtsam.NonlinearFactor], rotation: Array, translation: Array, scale: float, shift: float
) -> tuple[Array, Array, float, float]:
    """Levenberg-Marquardt over `POSE` and `AFFINE`.

    Args:
        factors: on these two; rotation (3, 3), translation (3,), scale, shift: where the solution starts.

    Returns:
        Rotation and translation (`cam_from_world`), scale and shift.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        graph.add(factor)
    values.insert(POSE, pose_from_camera(rotation, translation))
    values.insert(AFFINE, np.array([scale, shift]))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(20)
    parameters.setRelativeErrorTol(1e-5)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    scale, shift = solution.atVector(AFFINE).tolist()
    return *camera_from_pose(solution.atPose3(POSE)), scale, shift
