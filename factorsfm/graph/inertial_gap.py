"""Poses of frames that show nothing, from an IMU and the poses of the frames around them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from factorsfm.graph.factors import camera_from_pose, pose_from_camera
from factorsfm.graph.inertial_chain import InertialState
from factorsfm.graph.inertial_factors import inertial_factor, preintegrated
from factorsfm.inertial.recording import ImuRecording

Array = NDArray[np.float64]

_STEPS = 30
_LEAST_VARIANCE = 1e-14  # of a pose that is the world
_BIAS_SIGMAS = np.repeat([0.03, 1e-3], 3)  # m/s^2 and rad/s, of biases that a graph has estimated
_VELOCITY_SIGMA = 100.0  # m/s: nothing is known


def bridged_poses(
    recording: ImuRecording,
    time: Array,
    known: Mapping[int, tuple[Array, Array, Array]],
    state: InertialState,
) -> tuple[Array, Array, Array]:
    """Poses at successive times, of which some are known; Levenberg-Marquardt over poses, velocities and biases.

    Args:
        recording: its rotation to the camera and time offset must be known.
        time: (m,) seconds on the video's clock, ascending.
        known: by row, rotation (3, 3) and translation (3,) (`cam_from_world`, metres) and covariance (6, 6) of the
            pose; two at least.
        state: gravity and biases.

    Returns:
        Rotations (m, 3, 3), translations (m, 3) and covariances (m, 6, 6) (`FrameResult.covariance`).

    Raises:
        InputError: the recording does not cover the times.
    """
    recording, graph, values = recording.at_camera(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    biases = state.gyroscope_bias, state.accelerometer_bias
    bias = gtsam.imuBias.ConstantBias(state.accelerometer_bias, state.gyroscope_bias)
    between = [preintegrated(recording, a, b, state.gravity, *biases) for a, b in itertools.pairwise(time.tolist())]
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(_BIAS_SIGMAS)))
    poses = _first_poses(known, between)
    centers = np.array([pose.translation() for pose in poses])
    velocities = np.gradient(centers, time, axis=0)
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
        values.insert(V(k), velocities[k])
        values.insert(B(k), bias)
        if k in known:
            covariance = known[k][2] + _LEAST_VARIANCE * np.eye(6)
            graph.add(gtsam.PriorFactorPose3(X(k), pose, gtsam.noiseModel.Gaussian.Covariance(covariance)))
    graph.add(gtsam.PriorFactorVector(V(0), velocities[0], gtsam.noiseModel.Isotropic.Sigma(3, _VELOCITY_SIGMA)))
    for k, measurements in enumerate(between):
        graph.add(inertial_factor(k, k + 1, measurements))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_STEPS)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, solved)
    cameras = [camera_from_pose(solved.atPose3(X(k))) for k in range(len(time))]
    covariances = np.array([marginals.marginalCovariance(X(k)) for k in range(len(time))])
    return np.array([turn for turn, _ in cameras]), np.array([shift for _, shift in cameras]), covariances


def _first_poses(
    known: Mapping[int, tuple[Array, Array, Array]], between: list[gtsam.PreintegratedCombinedMeasurements]
) -> list[gtsam.Pose3]:
    """Known poses; the others turned on by the gyroscope, their places between those of known ones."""
    rows = np.array(sorted(known))
    poses = {row: pose_from_camera(*known[row][:2]) for row in rows.tolist()}
    turns = {row: pose.rotation() for row, pose in poses.items()}
    for k in range(int(rows[0]) - 1, -1, -1):
        turns[k] = turns[k + 1].compose(between[k].deltaRij().inverse())
    for k in range(len(between)):
        if k + 1 not in turns:
            turns[k + 1] = turns[k].compose(between[k].deltaRij())
    places = np.array([poses[row].translation() for row in rows.tolist()])
    every = np.arange(len(between) + 1)
    centers = np.stack([np.interp(every, rows, places[:, axis]) for axis in range(3)], axis=1)
    return [gtsam.Pose3(turns[k], centers[k]) for k in every.tolist()]
