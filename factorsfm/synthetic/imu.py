"""An IMU on a smooth path of a camera, with exact truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from factorsfm.inertial.recording import GRAVITY, ImuNoise, ImuRecording
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import exponential, logarithm, right_jacobian
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic.scene import Floats

GRAVITY_DOWN = (0.0, GRAVITY, 0.0)  # of a level first camera, m/s^2

_KNOTS_PER_SECOND = 20.0  # of a handheld path
_SWINGS, _TURNS = (0.3, 1.5), (0.1, 1.0)  # slowest and fastest of its motion and rotation, cycles a second


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """What a camera does at m times.

    Attributes:
        world_from_cam: (m, 3, 3).
        center, velocity, acceleration: (m, 3) metres and seconds, in the world.
        angular_velocity, angular_acceleration: (m, 3) rad/s and rad/s^2, in the camera's axes.
    """

    world_from_cam: Floats
    center: Floats
    velocity: Floats
    acceleration: Floats
    angular_velocity: Floats
    angular_acceleration: Floats


class SmoothPath:
    """A camera path through given poses: cubic splines of the centre and of the rotation vector from the first pose.

    Velocities and accelerations are continuous and exact. The path turns by less than half a turn from its first pose.

    Args:
        time: (n,) seconds, ascending, n at least 3.
        cam_from_world: n poses in a metric world.

    Raises:
        InputError: fewer than 3 poses, or times that do not ascend.
    """

    def __init__(self, time: Floats, cam_from_world: Sequence[pycolmap.Rigid3d]) -> None:
        if len(time) < 3 or len(time) != len(cam_from_world) or not (np.diff(time) > 0).all():
            raise InputError(f"a path needs at least 3 poses with ascending times; {len(time)} times are given")
        rotations, centers = pose_arrays(cam_from_world)
        self.time = np.asarray(time, np.float64)
        self._first = rotations[0]
        self._knots = np.column_stack([centers, logarithm(self._first.T @ rotations)])
        self._curvature = _natural_curvature(self.time, self._knots)

    def motion(self, time: Floats) -> CameraMotion:
        """Poses and their derivatives at m times within the path, seconds, (m,)."""
        values, rates, curvatures = self._spline(np.asarray(time, np.float64))
        vector, rate, curvature = values[:, 3:], rates[:, 3:], curvatures[:, 3:]
        by_rate = right_jacobian(vector)
        return CameraMotion(
            self._first @ exponential(vector),
            values[:, :3],
            rates[:, :3],
            curvatures[:, :3],
            np.einsum("nij,nj->ni", by_rate, rate),
            np.einsum("nij,nj->ni", by_rate, curvature) + _turning_jacobian(vector, rate),
        )

    def poses(self, time: Floats) -> list[pycolmap.Rigid3d]:
        """cam_from_world at m times within the path, seconds, (m,)."""
        motion = self.motion(time)
        return [
            pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center).inverse()
            for rotation, center in zip(motion.world_from_cam, motion.center, strict=True)
        ]

    def _spline(self, time: Floats) -> tuple[Floats, Floats, Floats]:
        """Value, first and second derivative (m, 6) of the splines."""
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, len(self.time) - 2)
        h = (self.time[k + 1] - self.time[k])[:, None]
        b = (time - self.time[k])[:, None] / h
        a = 1 - b
        y0, y1, m0, m1 = self._knots[k], self._knots[k + 1], self._curvature[k], self._curvature[k + 1]
        value = a * y0 + b * y1 + ((a**3 - a) * m0 + (b**3 - b) * m1) * h**2 / 6
        rate = (y1 - y0) / h + ((1 - 3 * a**2) * m0 + (3 * b**2 - 1) * m1) * h / 6
        return value, rate, a * m0 + b * m1


def handheld_path(seconds: float, seed: int = 0, reach: float = 0.25, turn: float = 0.3) -> SmoothPath:
    """A path as of a camera that is moved by hand and looks around, from the identity.

    It swings with 0.3 to 1.5 cycles a second and turns with 0.1 to 1, the slower the farther.

    Args:
        seconds: duration.
        seed: of the swings.
        reach: largest distance from the start, metres.
        turn: largest rotation from the start about each axis, radians.
    """
    generator = np.random.default_rng([seed, 3])
    time = np.linspace(0, seconds, max(3, round(seconds * _KNOTS_PER_SECOND) + 1))
    frequency = np.hstack([generator.uniform(*cycles, (3, 3)) for cycles in (_SWINGS, _TURNS)])
    phase = generator.uniform(0, 2 * np.pi, (3, 6))
    swings = (np.sin(2 * np.pi * frequency * time[:, None, None] + phase) / frequency).sum(axis=1)
    swings -= swings[0]
    centers = reach * swings[:, :3] / np.linalg.norm(swings[:, :3], axis=1).max()
    rotations = turn * swings[:, 3:] / np.abs(swings[:, 3:]).max(axis=0)
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center).inverse()
        for rotation, center in zip(rotations, centers, strict=True)
    ]
    return SmoothPath(time, poses)


def simulate_imu(
    path: SmoothPath,
    rate: float = 200.0,
    *,
    gravity: Sequence[float] | Floats = GRAVITY_DOWN,
    gyroscope_bias: Sequence[float] | Floats = (0.0, 0.0, 0.0),
    accelerometer_bias: Sequence[float] | Floats = (0.0, 0.0, 0.0),
    cam_from_imu: Floats | None = None,
    lever_arm: Sequence[float] | Floats = (0.0, 0.0, 0.0),
    time_offset: float = 0.0,
    noise: ImuNoise | None = None,
    seed: int = 0,
) -> ImuRecording:
    """What an IMU on a camera records along a path.

    Args:
        path: of the camera.
        rate: samples a second.
        gravity: (3,) m/s^2 in the world, pointing down.
        gyroscope_bias, accelerometer_bias: (3,) at the start, in the IMU's axes, rad/s and m/s^2.
        cam_from_imu: (3, 3) rotation, None for the same axes; lever_arm: (3,) metres, the IMU in the camera's axes.
        time_offset: seconds; the IMU's clock shows the video's time less this.
        noise: white noise and random walks of the biases; None for exact samples.
        seed: of the noise.

    Returns:
        The recording with its true mounting and time offset.
    """
    arm, axes = np.asarray(lever_arm, np.float64), np.eye(3) if cam_from_imu is None else cam_from_imu
    time = np.linspace(path.time[0], path.time[-1], round((path.time[-1] - path.time[0]) * rate) + 1)
    motion = path.motion(time)
    turn = motion.angular_velocity
    force = np.einsum("nji,nj->ni", motion.world_from_cam, motion.acceleration - np.asarray(gravity))
    force = force + np.cross(motion.angular_acceleration, arm) + np.cross(turn, np.cross(turn, arm))
    gyroscope, accelerometer = turn @ axes + gyroscope_bias, force @ axes + accelerometer_bias
    if noise is not None:
        draw = np.random.default_rng([seed, 4]).standard_normal((4, len(time), 3))
        gyroscope += draw[0] * noise.gyroscope * rate**0.5
        gyroscope += np.cumsum(draw[1], axis=0) * noise.gyroscope_walk / rate**0.5
        accelerometer += draw[2] * noise.accelerometer * rate**0.5
        accelerometer += np.cumsum(draw[3], axis=0) * noise.accelerometer_walk / rate**0.5
    return ImuRecording(time - time_offset, gyroscope, accelerometer, axes, arm, time_offset, noise or ImuNoise())


def _natural_curvature(time: Floats, knots: Floats) -> Floats:
    """Second derivatives (n, c) at the knots (n, c) of cubic splines that end without curvature."""
    h, slope = np.diff(time), np.diff(knots, axis=0) / np.diff(time)[:, None]
    system = np.diag(2 * (h[:-1] + h[1:])) + np.diag(h[1:-1], 1) + np.diag(h[1:-1], -1)
    curvature = np.zeros_like(knots)
    curvature[1:-1] = np.linalg.solve(system, 6 * np.diff(slope, axis=0))
    return curvature


def _turning_jacobian(vector: Floats, rate: Floats) -> Floats:
    """(n, 3) time derivative of `right_jacobian` times the rate, for rotation vectors and their rates (n, 3)."""
    angle = np.linalg.norm(vector, axis=1)[:, None]
    safe, small = np.maximum(angle, 0.03), angle < 0.03
    sixth = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    half_slope = np.where(small, angle**2 / 180 - 1 / 12, (safe * np.sin(safe) - 2 + 2 * np.cos(safe)) / safe**4)
    sixth_slope = np.where(
        small, angle**2 / 1260 - 1 / 60, (3 * np.sin(safe) - 2 * safe - safe * np.cos(safe)) / safe**5
    )
    along, across = (vector * rate).sum(axis=1)[:, None], np.cross(vector, rate)
    turned = along * (sixth_slope * np.cross(vector, across) - half_slope * across)
    return np.asarray(turned + sixth * np.cross(rate, across))
