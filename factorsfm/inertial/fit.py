"""What an IMU has given a result."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ImuFit:
    """The part of an IMU in a result; vectors are in its world, which is metric then.

    Attributes:
        up: (3,) unit vector against gravity; up_std: standard deviation about its worst axis, degrees.
        scale_std: relative standard deviation of all lengths.
        cam_from_imu: (3, 3) rotation from the IMU's axes to the camera's; rotation_std: about its worst axis, degrees,
            0 where it was given.
        time_offset: seconds to add to the IMU's time to get the video's; time_offset_std: 0 where it was given.
        gyroscope_bias, accelerometer_bias: (3,) at the first keyframe in the camera's axes, rad/s and m/s^2.
        frames: number of frames whose poses are the IMU's, since their images show nothing.
    """

    up: list[float]
    up_std: float
    scale_std: float
    cam_from_imu: list[list[float]]
    rotation_std: float
    time_offset: float
    time_offset_std: float
    gyroscope_bias: list[float]
    accelerometer_bias: list[float]
    frames: int = 0
