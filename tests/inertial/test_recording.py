from dataclasses import replace

import numpy as np
import pytest

from factorsfm.inertial.recording import GRAVITY, ImuNoise, ImuRecording
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import exponential
from factorsfm.synthetic.imu import handheld_path, simulate_imu

TIME = np.arange(0.0, 1.0, 0.01)
REST = np.zeros((100, 3)), np.tile([0.0, -GRAVITY, 0.0], (100, 1))


def test_a_resting_imu_is_accepted():
    recording = ImuRecording(TIME, *REST)
    assert recording.cam_from_imu is None
    assert recording.time_offset is None
    np.testing.assert_array_equal(recording.lever_arm, np.zeros(3))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"gyroscope": np.zeros((99, 3))}, r'"gyroscope" of an IMU has the shape \(99, 3\); \(100, 3\) is expected'),
        ({"accelerometer": [["a", "b", "c"]] * 100}, '"accelerometer" of an IMU holds what is no number'),
        ({"gyroscope": np.full((100, 3), np.nan)}, '"gyroscope" of an IMU is nan in row 0; a finite number'),
        (
            {"accelerometer": np.full((100, 3), 1e200)},
            '"accelerometer" of an IMU is 1e\\+200 in row 0; a finite number',
        ),
        ({"time": TIME[::-1]}, r"the time of an IMU goes from 0.990000 to 0.980000 s in row 1; it must ascend"),
        ({"time": 3 * TIME}, "an IMU recorded 33.3 samples a second; at least 50 are needed"),
        ({"time": TIME + 0.2 * (TIME > 0.5)}, r"a gap of 0.21 s at 0.500 s; at most 0.1 s can be bridged"),
        ({"gyroscope": np.full((100, 3), 30.0)}, "the median angular velocity of an IMU is 52 rad/s"),
        ({"accelerometer": REST[1] / GRAVITY}, "the median of the accelerometer's magnitude is 1 m/s"),
        ({"accelerometer": np.zeros((100, 3))}, "the median of the accelerometer's magnitude is 0 m/s"),
        ({"time_offset": np.inf}, "the time offset of the IMU is inf; seconds are expected"),
        ({"lever_arm": [20.0, 0.0, 15.0]}, "the IMU is 25 m from the camera; at most 10 is expected"),
        ({"cam_from_imu": np.diag([1.0, 1.0, -1.0])}, "which is no rotation matrix"),
        ({"time": [0.0], "gyroscope": REST[0][:1], "accelerometer": REST[1][:1]}, "has 1 samples; at least 2"),
    ],
)
def test_a_recording_that_cannot_be_is_refused(changed, message):
    arguments = {"time": TIME, "gyroscope": REST[0], "accelerometer": REST[1], **changed}
    with pytest.raises(InputError, match=message):
        ImuRecording(**arguments)


def test_noise_must_be_positive():
    with pytest.raises(InputError, match='IMU noise "gyroscope" is -1; a positive number is expected'):
        ImuNoise(gyroscope=-1.0)


def test_an_imu_off_the_camera_is_moved_into_its_centre():
    path = handheld_path(4.0, 2)
    mounting = {"cam_from_imu": exponential(np.array([[0.4, -1.0, 0.3]]))[0], "lever_arm": [0.06, -0.03, 0.02]}
    moved = simulate_imu(path, **mounting, time_offset=0.4).at_camera()
    at_center = simulate_imu(path)
    np.testing.assert_allclose(moved.time, at_center.time, atol=1e-12)
    np.testing.assert_allclose(moved.gyroscope, at_center.gyroscope, atol=1e-12)
    # The gyroscope is differentiated, which rounds the kinks of its slope; at its ends to one side only.
    np.testing.assert_allclose(moved.accelerometer[1:-1], at_center.accelerometer[1:-1], atol=0.01)
    ignored = simulate_imu(path, **mounting, time_offset=0.4)
    ignored = replace(ignored, lever_arm=np.zeros(3)).at_camera()
    assert abs(ignored.accelerometer - at_center.accelerometer).max() > 0.1


def test_an_imu_in_the_camera_stays_there():
    recording = simulate_imu(handheld_path(1.0))
    assert recording.at_camera() is recording


def test_the_mounting_must_be_known():
    with pytest.raises(InputError, match="the rotation from the IMU to the camera or its time offset is unknown"):
        ImuRecording(TIME, *REST, time_offset=0.0).at_camera()
