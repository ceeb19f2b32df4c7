"""The recording of an IMU: samples with their clock and axes, and what is known of its noise and mounting."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2

_LARGEST = 1e12  # of a number: its square stays finite
_LOWEST_RATE = 50.0  # samples per second
_LONGEST_GAP = 0.1  # seconds: interpolated over more, a hand's motion is lost
_LARGEST_TURN = 10.0  # rad/s, median: no camera turns so fast for half of a shot, but one in degrees does
_LONGEST_LEVER = 10.0  # metres
_FORCE_RANGE = (0.5 * GRAVITY, 2.0 * GRAVITY)  # m/s^2, median


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an IMU, the same along its three axes; the defaults are those of the IMU of a phone.

    Attributes:
        gyroscope: density of its white noise, rad/s/sqrt(Hz).
        accelerometer: density of its white noise, m/s^2/sqrt(Hz).
        gyroscope_walk: density of the random walk of its bias, rad/s^2/sqrt(Hz).
        accelerometer_walk: density of the random walk of its bias, m/s^3/sqrt(Hz).
        gyroscope_bias: standard deviation of its bias at the start, rad/s.
        accelerometer_bias: standard deviation of its bias at the start, m/s^2.
        accelerometer_scale: relative error of the accelerometer's scale, by which all lengths may be off.

    Raises:
        InputError: a value is not positive.
    """

    gyroscope: float = 2e-4
    accelerometer: float = 2e-3
    gyroscope_walk: float = 1e-5
    accelerometer_walk: float = 2e-4
    gyroscope_bias: float = 0.02
    accelerometer_bias: float = 0.2
    accelerometer_scale: float = 0.005

    def __post_init__(self) -> None:
        for one in dataclasses.fields(self):
            value = getattr(self, one.name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f'IMU noise "{one.name}" is {value:g}; a positive number is expected')


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecording:
    """Samples of a gyroscope and an accelerometer.

    Attributes:
        time: (n,) seconds on the IMU's clock, ascending.
        gyroscope: (n, 3) angular velocity, rad/s, in the IMU's axes (right-handed).
        accelerometer: (n, 3) specific force, m/s^2, in the IMU's axes: at rest it shows 9.81 upwards.
        cam_from_imu: (3, 3) rotation from the IMU's axes to the camera's (x right, y down, z forward); None if unknown.
        lever_arm: (3,) metres, position of the IMU in the camera's axes.
        time_offset: seconds to add to the IMU's time to get the video's; None if unknown.
        noise: of the samples.

    Raises:
        InputError: sizes that do not agree, values that are not finite, times that do not ascend, fewer than 50 samples
            a second, a gap of more than 0.1 s, or magnitudes or a lever arm that no IMU in these units shows.
    """

    time: Array
    gyroscope: Array
    accelerometer: Array
    cam_from_imu: Array | None = None
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    time_offset: float | None = None
    noise: ImuNoise = field(default_factory=ImuNoise)

    def __post_init__(self) -> None:
        n = np.size(self.time)
        shapes = {"time": (n,), "gyroscope": (n, 3), "accelerometer": (n, 3), "lever_arm": (3,), "cam_from_imu": (3, 3)}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _checked(name, getattr(self, name), shape))
        if self.time_offset is not None and not np.isfinite(self.time_offset):
            raise InputError(f"the time offset of the IMU is {self.time_offset}; seconds are expected")
        if (distance := float(np.linalg.norm(self.lever_arm))) > _LONGEST_LEVER:
            raise InputError(
                f"the IMU is {distance:.3g} m from the camera; at most {_LONGEST_LEVER:g} is expected "
                "(millimetres instead of metres?)"
            )
        if self.cam_from_imu is not None:
            _check_rotation(self.cam_from_imu)
        _check_times(self.time)
        _check_magnitudes(self.gyroscope, self.accelerometer)

    def at_camera(self) -> ImuRecording:
        """What an IMU in the camera's centre with the camera's axes and the video's clock would have recorded.

        Off the camera's centre an IMU feels the centripetal acceleration and that of the angular acceleration; both
        are taken away, the latter with the gyroscope differentiated.

        Raises:
            InputError: `cam_from_imu` or `time_offset` is unknown; `fit_timing` estimates them.
        """
        if self.cam_from_imu is None or self.time_offset is None:
            raise InputError("the rotation from the IMU to the camera or its time offset is unknown; both are needed")
        if self.time_offset == 0 and not self.lever_arm.any() and np.array_equal(self.cam_from_imu, np.eye(3)):
            return self
        turn = self.gyroscope @ self.cam_from_imu.T
        force = self.accelerometer @ self.cam_from_imu.T
        if self.lever_arm.any():
            faster = np.gradient(turn, self.time, axis=0)
            force = force - np.cross(faster, self.lever_arm) - np.cross(turn, np.cross(turn, self.lever_arm))
        return dataclasses.replace(
            self,
            time=self.time + self.time_offset,
            gyroscope=turn,
            accelerometer=force,
            cam_from_imu=np.eye(3),
            lever_arm=np.zeros(3),
            time_offset=0.0,
        )


def _checked(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f'"{name}" of an IMU holds what is no number') from error
    if array.shape != shape:
        raise InputError(f'"{name}" of an IMU has the shape {array.shape}; {shape} is expected')
    usable = np.abs(array) < _LARGEST  # NaN is not
    if not usable.all():
        where = tuple(np.argwhere(~usable)[0])
        raise InputError(f'"{name}" of an IMU is {array[where]:g} in row {where[0]}; a finite number is expected')
    return array


def _check_rotation(rotation: Array) -> None:
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(f"the rotation from the IMU to the camera is {rotation.tolist()}, which is no rotation matrix")


def _check_times(time: Array) -> None:
    if len(time) < 2:
        raise InputError(f"a recording of an IMU has {len(time)} samples; at least 2 are needed")
    steps = np.diff(time)
    if steps.min() <= 0:
        row = int(np.argmax(steps <= 0)) + 1
        raise InputError(
            f"the time of an IMU goes from {time[row - 1]:.6f} to {time[row]:.6f} s in row {row}; it must ascend"
        )
    rate = 1.0 / np.median(steps)
    if rate < 0.99 * _LOWEST_RATE:
        raise InputError(f"an IMU recorded {rate:.3g} samples a second; at least {_LOWEST_RATE:g} are needed")
    if steps.max() > _LONGEST_GAP:
        row = int(np.argmax(steps))
        raise InputError(
            f"a recording of an IMU has a gap of {steps[row]:.3g} s at {time[row]:.3f} s; "
            f"at most {_LONGEST_GAP:g} s can be bridged"
        )


def _check_magnitudes(gyroscope: Array, accelerometer: Array) -> None:
    turn = float(np.median(np.linalg.norm(gyroscope, axis=1)))
    if turn > _LARGEST_TURN:
        raise InputError(
            f"the median angular velocity of an IMU is {turn:.3g} rad/s; at most {_LARGEST_TURN:g} is expected "
            "(degrees instead of radians?)"
        )
    force = float(np.median(np.linalg.norm(accelerometer, axis=1)))
    if not _FORCE_RANGE[0] <= force <= _FORCE_RANGE[1]:
        raise InputError(
            f"the median of the accelerometer's magnitude is {force:.3g} m/s^2; about {GRAVITY:g} is expected, "
            "since it shows gravity, too"
        )
