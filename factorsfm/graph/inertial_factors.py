"""IMU factors between the poses of frames, in GTSAM's own types.

Keys are ``X(i)`` pose of the camera, `world_from_cam`; ``V(i)`` its velocity in the world, units/s; ``B(i)`` biases of
the accelerometer, units/s^2, and the gyroscope, rad/s, in the camera's axes, `imuBias.ConstantBias`. The unit of the
world is `scale` metres: 1 in a metric world; a map without scale is held to this one by the factors.

GTSAM's "body" is the camera: the samples are those of an IMU in the camera's centre (`ImuRecording.at_camera`).
`body_P_sensor` stays unset, since with it GTSAM leaves out what the lever arm makes of the angular acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from factorsfm.inertial.alignment import InertialAlignment
from factorsfm.inertial.preintegration import inertial_steps
from factorsfm.inertial.recording import ImuNoise, ImuRecording
from factorsfm.support.rotations import exponential

Array = NDArray[np.float64]

# Of the position, m/sqrt(s): GTSAM must have some; 0.03 mm in 0.3 s is below what any camera sees.
_INTEGRATION_NOISE = 5e-5
_MAGNITUDE_SIGMA, _ACROSS_SIGMA = 0.02, 2.0  # of gravity, m/s^2: 9.78 to 9.83 on the Earth; a tenth of its direction


def preintegrated(
    recording: ImuRecording,
    start: float,
    end: float,
    gravity: Array,
    gyroscope_bias: Array,
    accelerometer_bias: Array,
    scale: float = 1.0,
) -> gtsam.PreintegratedCombinedMeasurements:
    """The samples between two times, preintegrated for `inertial_factor`.

    Args:
        recording: its rotation to the camera and time offset must be known.
        start, end: seconds on the video's clock.
        gravity: (3,) m/s^2 in the world, pointing down.
        gyroscope_bias, accelerometer_bias: (3,) first values in the camera's axes, rad/s and m/s^2.
        scale: metres per unit of the world.

    Raises:
        InputError: the interval does not ascend or is not in the recording.
    """
    recording = recording.at_camera()
    (durations,), (turns,), (forces,) = inertial_steps(recording, np.array([start]), np.array([end]))
    # GTSAM takes the force in the axes of the start of a step, where it is measured in the middle.
    half_turns = exponential(durations[:, None] / 2 * (turns - gyroscope_bias))
    forces = np.einsum("kij,kj->ki", half_turns, forces - accelerometer_bias) + accelerometer_bias
    bias = gtsam.imuBias.ConstantBias(accelerometer_bias / scale, gyroscope_bias)
    measurements = gtsam.PreintegratedCombinedMeasurements(_parameters(recording.noise, gravity, scale), bias)
    for duration, turn, force in zip(durations, turns, forces / scale, strict=True):
        if duration > 0:  # the last step is none where a sample falls on the end
            measurements.integrateMeasurement(force, turn, duration)
    return measurements


def inertial_factor(
    i: int, j: int, measurements: gtsam.PreintegratedCombinedMeasurements, gravity_key: int | None = None
) -> gtsam.CombinedImuFactor | gtsam.CombinedImuFactorWithGravityVector:
    """The factor between ``X(i), V(i), B(i)`` and ``X(j), V(j), B(j)``.

    Args:
        measurements: between the times of the frames i and j.
        gravity_key: of a `Point3`, gravity in the world, units/s^2, to be estimated with `gravity_prior`; None holds
            that of the measurements.
    """
    keys = (X(i), V(i), X(j), V(j), B(i), B(j))
    if gravity_key is None:
        return gtsam.CombinedImuFactor(*keys, measurements)
    return gtsam.CombinedImuFactorWithGravityVector(*keys, gravity_key, measurements)


def bias_prior(
    i: int, noise: ImuNoise, gyroscope_bias: Array, accelerometer_bias: Array, scale: float = 1.0
) -> gtsam.PriorFactorConstantBias:
    """Prior of ``B(i)`` around biases (3,) in the camera's axes, rad/s and m/s^2, as loose as `ImuNoise` says."""
    sigmas = np.repeat([noise.accelerometer_bias / scale, noise.gyroscope_bias], 3)
    mean = gtsam.imuBias.ConstantBias(accelerometer_bias / scale, gyroscope_bias)
    return gtsam.PriorFactorConstantBias(B(i), mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def gravity_prior(key: int, gravity: Array, scale: float = 1.0) -> gtsam.PriorFactorPoint3:
    """Prior of gravity (3,), m/s^2 in the world, that holds its magnitude and hardly its direction.

    GTSAM's factors take a `Unit3`, too, but values with one cannot be written for another process.
    """
    down = gravity / np.linalg.norm(gravity)
    along = np.outer(down, down)
    covariance = _MAGNITUDE_SIGMA**2 * along + _ACROSS_SIGMA**2 * (np.eye(3) - along)
    return gtsam.PriorFactorPoint3(key, gravity / scale, gtsam.noiseModel.Gaussian.Covariance(covariance / scale**2))


def inertial_graph(
    recording: ImuRecording,
    frames: Sequence[int],
    time: Array,
    alignment: InertialAlignment,
    gravity_key: int | None = None,
    scale: float = 1.0,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The factors between successive keyframes and the priors of biases and gravity; first values of all but the poses.

    The biases have a prior around zero, since those of the alignment come from the same samples.

    Args:
        recording: its rotation to the camera and time offset must be known.
        frames: the m numbers of the keyframes, the i of ``X(i)``.
        time: (m,) seconds on the video's clock, ascending.
        alignment: of these keyframes.
        gravity_key: of a `Point3`, gravity in the world, units/s^2, to be estimated; None holds the alignment's.
        scale: metres per unit of the world of the poses.

    Raises:
        InputError: the recording does not cover the keyframes.
    """
    recording, graph, values = recording.at_camera(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    biases = alignment.gyroscope_bias, alignment.accelerometer_bias
    graph.add(bias_prior(frames[0], recording.noise, np.zeros(3), np.zeros(3), scale))
    for k, (i, velocity) in enumerate(zip(frames, alignment.velocities, strict=True)):
        values.insert(V(i), velocity / scale)
        values.insert(B(i), gtsam.imuBias.ConstantBias(alignment.accelerometer_bias / scale, alignment.gyroscope_bias))
        if k > 0:
            measurements = preintegrated(recording, time[k - 1], time[k], alignment.gravity, *biases, scale)
            graph.add(inertial_factor(frames[k - 1], i, measurements, gravity_key))
    if gravity_key is not None:
        values.insert(gravity_key, alignment.gravity / scale)
        graph.add(gravity_prior(gravity_key, alignment.gravity, scale))
    return graph, values


def _parameters(noise: ImuNoise, gravity: Array, scale: float) -> gtsam.PreintegrationCombinedParams:
    parameters = gtsam.PreintegrationCombinedParams(gravity / scale)
    parameters.setGyroscopeCovariance(noise.gyroscope**2 * np.eye(3))
    parameters.setAccelerometerCovariance((noise.accelerometer / scale) ** 2 * np.eye(3))
    parameters.setIntegrationCovariance((_INTEGRATION_NOISE / scale) ** 2 * np.eye(3))
    parameters.setBiasOmegaCovariance(noise.gyroscope_walk**2 * np.eye(3))
    parameters.setBiasAccCovariance((noise.accelerometer_walk / scale) ** 2 * np.eye(3))
    return parameters
