"""Preintegration: what an IMU says of the motion between two times before gravity, scale and velocity are known.

Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry" (2017), with
the specific force taken in the middle of each step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.inertial.recording import ImuRecording
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import cross_matrices, exponential, right_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Preintegration:
    """Motion of a camera over m intervals, each in the axes of the camera at its start, without gravity.

    With ``R = world_from_cam``, centre ``p``, velocity ``v`` and gravity ``g`` (pointing down) in a metric world, and
    the interval of T seconds from i to j: ``rotation = Ri' Rj``, ``velocity = Ri' (vj - vi - g T)``,
    ``position = Ri' (pj - pi - vi T - g T^2 / 2)``.

    Attributes:
        duration: (m,) seconds.
        rotation: (m, 3, 3) from the axes at the end to those at the start.
        velocity: (m, 3) m/s.
        position: (m, 3) metres.
        covariance: (m, 9, 9) of the rotation vector (perturbed on the right), velocity and position, from white noise.
        by_bias: (m, 9, 6) derivative of these by the bias of the gyroscope and the accelerometer.
    """

    duration: Array
    rotation: Array
    velocity: Array
    position: Array
    covariance: Array
    by_bias: Array


def inertial_steps(recording: ImuRecording, starts: Array, ends: Array) -> tuple[Array, Array, Array]:
    """The samples between times, averaged over the steps between them and interpolated at both ends.

    Args:
        recording: any clock and axes.
        starts, ends: (m,) seconds on the clock of the recording.

    Returns:
        Of the k steps of each interval the duration (m, k), seconds, the angular velocity (m, k, 3), and the specific
        force (m, k, 3) in the axes of the middle of the step. Short intervals end in steps of no duration.

    Raises:
        InputError: an interval does not ascend or is not in the recording.
    """
    if not (ends > starts).all():
        raise InputError("an interval of an IMU ends before it starts")
    time = recording.time
    if starts.min() < time[0] - 1e-9 or ends.max() > time[-1] + 1e-9:
        raise InputError(
            f"the recording of the IMU covers {time[0]:.3f} to {time[-1]:.3f} s; "
            f"{starts.min():.3f} to {ends.max():.3f} s are asked for"
        )
    first, last = np.searchsorted(time, starts, "right"), np.searchsorted(time, ends, "left")
    row = first[:, None] + np.arange((last - first).max())
    between = np.where(row < last[:, None], time[np.minimum(row, len(time) - 1)], ends[:, None])
    knots = np.column_stack([starts, between, ends])
    turn, force = (
        np.stack([np.interp(knots, time, axis) for axis in samples.T], -1)
        for samples in (recording.gyroscope, recording.accelerometer)
    )
    return np.diff(knots, axis=1), (turn[:, 1:] + turn[:, :-1]) / 2, (force[:, 1:] + force[:, :-1]) / 2


def preintegrate(
    recording: ImuRecording, starts: Array, ends: Array, gyroscope_bias: Array, accelerometer_bias: Array
) -> Preintegration:
    """Preintegrate a recording over m intervals at once.

    Args:
        recording: as `ImuRecording.at_camera` gives it.
        starts, ends: (m,) seconds on the clock of the recording.
        gyroscope_bias, accelerometer_bias: (3,) to subtract, rad/s and m/s^2.

    Raises:
        InputError: an interval does not ascend or is not in the recording.
    """
    durations, turns, forces = inertial_steps(recording, np.asarray(starts), np.asarray(ends))
    m, k = durations.shape
    steps = _steps(durations.T, (turns - gyroscope_bias).swapaxes(0, 1), (forces - accelerometer_bias).swapaxes(0, 1))
    rotation, velocity, position = np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)), np.zeros((m, 3))
    covariance, by_bias = np.zeros((m, 9, 9)), np.zeros((m, 9, 6))
    white = np.repeat([recording.noise.gyroscope**2, recording.noise.accelerometer**2], 3)
    for j in range(k):
        t = steps.duration[j][:, None]
        advance, by_rate = _step_derivatives(steps, j, rotation)
        by_bias = advance @ by_bias - t[:, None] * by_rate
        covariance = advance @ covariance @ advance.swapaxes(1, 2)
        covariance += t[:, None] * (by_rate * white) @ by_rate.swapaxes(1, 2)
        acceleration = (rotation @ steps.force[j][:, :, None])[:, :, 0]
        position = position + t * velocity + t**2 / 2 * acceleration
        velocity = velocity + t * acceleration
        rotation = rotation @ steps.rotation[j]
    return Preintegration(durations.sum(axis=1), rotation, velocity, position, covariance, by_bias)


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """What k steps of m intervals do, each in the axes at its start: everything that needs no earlier step.

    Attributes:
        duration: (k, m).
        rotation: (k, m, 3, 3); by_turn: (k, m, 3, 3) its derivative by the angular velocity, over the duration.
        force: (k, m, 3), turned back from the middle of the step.
        force_by_rotation: (k, m, 3, 3) by the rotation at the start; force_by_turn: by the angular velocity;
            force_by_force: by the force in the middle.
    """

    duration: Array
    rotation: Array
    by_turn: Array
    force: Array
    force_by_rotation: Array
    force_by_turn: Array
    force_by_force: Array


def _steps(duration: Array, turn: Array, force: Array) -> _Steps:
    """Of durations (k, m), angular velocities and specific forces (k, m, 3), both without bias."""
    shape = (*duration.shape, 3, 3)
    angle = (duration[:, :, None] * turn).reshape(-1, 3)
    half, by_half = exponential(angle / 2).reshape(shape), right_jacobian(angle / 2).reshape(shape)
    by_middle = -half @ cross_matrices(force.reshape(-1, 3)).reshape(shape)
    return _Steps(
        duration,
        half @ half,
        right_jacobian(angle).reshape(shape),
        np.einsum("kmij,kmj->kmi", half, force),
        by_middle @ half.swapaxes(2, 3),
        duration[:, :, None, None] / 2 * by_middle @ by_half,
        half,
    )


def _step_derivatives(steps: _Steps, j: int, rotation: Array) -> tuple[Array, Array]:
    """Of the state (rotation, velocity, position) after step j: (m, 9, 9) by the state before it; and (m, 9, 6) by the
    angular velocity and the specific force, over the duration of the step."""
    t = steps.duration[j][:, None, None]
    by_rotation, by_turn = rotation @ steps.force_by_rotation[j], rotation @ steps.force_by_turn[j]
    by_force = rotation @ steps.force_by_force[j]
    advance = np.tile(np.eye(9), (len(t), 1, 1))
    advance[:, :3, :3] = steps.rotation[j].swapaxes(1, 2)
    advance[:, 3:6, :3], advance[:, 6:, :3] = t * by_rotation, t**2 / 2 * by_rotation
    advance[:, 6:, 3:6] = t * np.eye(3)
    by_rate = np.zeros((len(t), 9, 6))
    by_rate[:, :3, :3] = steps.by_turn[j]
    by_rate[:, 3:6, :3], by_rate[:, 6:, :3] = by_turn, t / 2 * by_turn
    by_rate[:, 3:6, 3:], by_rate[:, 6:, 3:] = by_force, t / 2 * by_force
    return advance, by_rate
