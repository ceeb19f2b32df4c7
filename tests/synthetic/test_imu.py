import numpy as np
import pytest

from factorsfm.inertial.recording import ImuNoise
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import logarithm
from factorsfm.synthetic.imu import SmoothPath, handheld_path, simulate_imu


def test_a_path_goes_through_its_poses():
    poses = handheld_path(2.0, 3).poses(np.linspace(0, 2, 30))
    path = SmoothPath(np.linspace(0, 2, 30), poses)
    for given, found in zip(poses, path.poses(path.time), strict=True):
        np.testing.assert_allclose(found.matrix(), given.matrix(), atol=1e-12)


def test_motion_is_the_derivative_of_the_poses():
    path, time, h = handheld_path(5.0, 1, turn=1.5), np.linspace(0.01, 4.99, 400), 1e-5
    now, before, after = path.motion(time), path.motion(time - h), path.motion(time + h)
    turn = logarithm(before.world_from_cam.swapaxes(1, 2) @ after.world_from_cam) / (2 * h)
    np.testing.assert_allclose((after.center - before.center) / (2 * h), now.velocity, atol=1e-8)
    np.testing.assert_allclose((after.velocity - before.velocity) / (2 * h), now.acceleration, atol=2e-3)
    np.testing.assert_allclose(turn, now.angular_velocity, atol=1e-8)
    faster = (after.angular_velocity - before.angular_velocity) / (2 * h)
    np.testing.assert_allclose(faster, now.angular_acceleration, atol=2e-3)


def test_a_handheld_path_starts_at_the_identity_and_accelerates():
    path = handheld_path(6.0, 0)
    motion = path.motion(path.time)
    np.testing.assert_allclose(path.poses(path.time[:1])[0].matrix(), np.eye(4)[:3], atol=1e-12)
    assert np.linalg.norm(motion.center, axis=1).max() == pytest.approx(0.25)
    assert 0.5 < np.sqrt(np.mean(motion.acceleration**2)) < 2.0


def test_at_rest_the_accelerometer_shows_gravity_upwards():
    still = SmoothPath(np.array([0.0, 1.0, 2.0]), handheld_path(1.0).poses(np.zeros(3)))
    recording = simulate_imu(still, gravity=(0.0, 9.81, 0.0))  # y points down
    np.testing.assert_allclose(recording.accelerometer, np.tile([0.0, -9.81, 0.0], (401, 1)), atol=1e-12)
    np.testing.assert_allclose(recording.gyroscope, 0.0, atol=1e-12)


def test_noise_has_the_density_that_is_given():
    path, noise = handheld_path(20.0), ImuNoise(gyroscope_walk=1e-9, accelerometer_walk=1e-9)
    noisy, exact = simulate_imu(path, 400.0, noise=noise), simulate_imu(path, 400.0)
    for name in ("gyroscope", "accelerometer"):
        spread = np.std(getattr(noisy, name) - getattr(exact, name))
        assert spread == pytest.approx(getattr(noise, name) * 20.0, rel=0.03)


def test_two_poses_are_no_path():
    with pytest.raises(InputError, match="a path needs at least 3 poses with ascending times; 2 times are given"):
        SmoothPath(np.array([0.0, 1.0]), handheld_path(1.0).poses(np.zeros(2)))
