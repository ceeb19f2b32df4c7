"""Recordings of an IMU and the poses of its camera, with exact truth."""

from dataclasses import dataclass

import numpy as np

from factorsfm.inertial.alignment import VisualPoses
from factorsfm.inertial.recording import GRAVITY, ImuNoise, ImuRecording
from factorsfm.support.rotations import exponential
from factorsfm.synthetic.imu import CameraMotion, handheld_path, simulate_imu

METRES_PER_UNIT = 3.7


@dataclass(frozen=True)
class InertialProblem:
    """A handheld camera with an IMU in its centre, and its keyframes in a map without scale.

    `gravity` (3,) is in the world of the first camera; the biases (3,) are in the camera's axes; `motion` is the truth
    at the keyframes, in metres.
    """

    recording: ImuRecording
    poses: VisualPoses
    gravity: np.ndarray
    gyroscope_bias: np.ndarray
    accelerometer_bias: np.ndarray
    motion: CameraMotion


def inertial_problem(seed, noisy=True, seconds=6.0, reach=0.25, turn=0.3, noise=None):
    """Keyframes 0.3 s apart; noise: 0.1 % of the path, 0.02 degrees, that of a phone's IMU and its biases."""
    rng = np.random.default_rng([seed, 99])
    path = handheld_path(seconds, seed, reach, turn)
    gravity = np.array([0.0, 1.0, 0.0]) + 0.3 * rng.standard_normal(3)
    gravity *= GRAVITY / np.linalg.norm(gravity)
    biases = 0.01 * rng.standard_normal(3) * noisy, 0.1 * rng.standard_normal(3) * noisy
    recording = simulate_imu(
        path,
        gravity=gravity,
        gyroscope_bias=biases[0],
        accelerometer_bias=biases[1],
        noise=(noise or ImuNoise()) if noisy else None,
        seed=seed,
    )
    time = np.arange(0.0, seconds - 0.01, 0.3)
    motion = path.motion(time)
    dense = path.motion(np.linspace(0, seconds, 300)).center
    sigma = 1e-3 * np.linalg.norm(np.diff(dense, axis=0), axis=1).sum(), np.radians(0.02)
    centers, rotations = motion.center, motion.world_from_cam
    if noisy:
        centers = centers + sigma[0] * rng.standard_normal(centers.shape)
        rotations = rotations @ exponential(sigma[1] * rng.standard_normal(centers.shape))
    covariance = np.diag(np.repeat([sigma[1] ** 2, (max(sigma[0], 1e-4) / METRES_PER_UNIT) ** 2], 3))
    poses = VisualPoses(time, rotations, centers / METRES_PER_UNIT, np.tile(covariance, (len(time), 1, 1)))
    return InertialProblem(recording, poses, gravity, *biases, motion)


def angle(a, b):
    """Degrees between two vectors."""
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))
