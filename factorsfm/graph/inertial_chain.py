"""The IMU in the live graph: one factor from keyframe to keyframe, and what the graph makes of its variables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors
from factorsfm.graph.contents import LiveGraph, empty_graph
from factorsfm.graph.factors import pose_from_camera
from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.graph.inertial_factors import inertial_factor, preintegrated
from factorsfm.graph.keys import letter_of
from factorsfm.inertial.recording import ImuRecording

Array = NDArray[np.float64]

GRAVITY_KEY = G(0)


@dataclass(frozen=True, slots=True)
class InertialState:
    """The IMU's variables at a keyframe, in a metric world.

    Attributes:
        velocity: (3,) m/s; gravity: (3,) m/s^2, pointing down.
        gyroscope_bias, accelerometer_bias: (3,) in the camera's axes, rad/s and m/s^2.
    """

    velocity: Array
    gravity: Array
    gyroscope_bias: Array
    accelerometer_bias: Array


def next_inertial_factor(
    recording: ImuRecording,
    frames: tuple[int, int],
    time: tuple[float, float],
    pose: tuple[Array, Array],
    state: InertialState,
) -> LiveGraph:
    """The factor that goes on from ``frames[0]``, and first values of the velocity and the biases at ``frames[1]``.

    Args:
        recording: its rotation to the camera and time offset must be known.
        frames: numbers of two keyframes; time: seconds on the video's clock.
        pose: `cam_from_world` of the first, metres; state: there.

    Raises:
        InputError: the recording does not cover the time between.
    """
    (i, j), (graph, values) = frames, empty_graph()
    measurements = preintegrated(recording, *time, state.gravity, state.gyroscope_bias, state.accelerometer_bias)
    bias = gtsam.imuBias.ConstantBias(state.accelerometer_bias, state.gyroscope_bias)
    predicted = measurements.predict(gtsam.NavState(pose_from_camera(*pose), state.velocity), bias)
    graph.add(inertial_factor(i, j, measurements, GRAVITY_KEY))
    values.insert(V(j), predicted.velocity())
    values.insert(B(j), bias)
    return graph, values


def inertial_state(added: AddedFactors, frame: int) -> InertialState | None:
    """What the graph has of the IMU at a keyframe; None where that has no part in the factors."""
    values = added.values()
    if not values.exists(V(frame)):
        return None
    bias = values.atConstantBias(B(frame))
    return InertialState(
        values.atVector(V(frame)), values.atPoint3(GRAVITY_KEY), bias.gyroscope(), bias.accelerometer()
    )


def posterior_state(
    factors: FactorsOnPoses, poses: Mapping[int, tuple[tuple[Array, Array], Array | None]]
) -> tuple[InertialState, float]:
    """The IMU's variables beside solved poses, at the first keyframe, and the std of gravity's direction, radians.

    Args:
        poses: `cam_from_world` and covariance (6, 6) by frame; the errors of different frames count as independent.
    """
    graph, values = factors.with_poses(poses)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    first = min(gtsam.symbolIndex(key) for key in list(solved.keys()) if letter_of(key) == "b")
    bias, gravity = solved.atConstantBias(B(first)), solved.atPoint3(GRAVITY_KEY)
    covariance = gtsam.Marginals(graph, solved).marginalCovariance(GRAVITY_KEY)
    across = np.eye(3) - np.outer(gravity, gravity) / (gravity @ gravity)
    std = float(np.sqrt(np.linalg.eigvalsh(across @ covariance @ across)[-1]) / np.linalg.norm(gravity))
    return InertialState(solved.atVector(V(first)), gravity, bias.gyroscope(), bias.accelerometer()), std
