"""Rotation of the camera between two times from the gyroscope alone, for frames in which the image shows nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.inertial.preintegration import preintegrate
from factorsfm.inertial.recording import ImuRecording

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeRotations:
    """Rotations of the camera over m intervals.

    Attributes:
        start_from_end: (m, 3, 3) from the camera's axes at the end to those at the start: ``Ri' Rj`` of world_from_cam.
        covariance: (m, 3, 3) of its rotation vector, perturbed on the right, radians squared.
    """

    start_from_end: Array
    covariance: Array


def gyroscope_rotations(
    recording: ImuRecording, starts: Array, ends: Array, bias: Array, bias_covariance: Array
) -> GyroscopeRotations:
    """Integrate the gyroscope over m intervals.

    Args:
        recording: its rotation to the camera and time offset must be known.
        starts, ends: (m,) seconds on the video's clock.
        bias: (3,) of the gyroscope in the camera's axes, rad/s.
        bias_covariance: (3, 3); the errors of all intervals share it.

    Raises:
        InputError: an interval does not ascend or is not in the recording.
    """
    motion = preintegrate(recording.at_camera(), starts, ends, bias, np.zeros(3))
    by_bias = motion.by_bias[:, :3, :3]
    covariance = motion.covariance[:, :3, :3] + by_bias @ bias_covariance @ by_bias.swapaxes(1, 2)
    return GyroscopeRotations(motion.rotation, covariance)
