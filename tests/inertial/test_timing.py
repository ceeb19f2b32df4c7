from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from factorsfm.inertial.recording import ImuNoise
from factorsfm.inertial.timing import fit_timing
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.rotations import exponential, logarithm
from factorsfm.synthetic.imu import SmoothPath, handheld_path, simulate_imu

FRAMES = np.arange(2.0, 7.0, 1 / 30)  # of a video on the way of a recording of 9 s
BIAS = np.array([0.01, -0.02, 0.015])


def problem(seed, noise=None, camera_noise=0.0, path=None):
    """A recording whose mounting is unknown, the rotations of the frames, and the true mounting and offset.

    Args:
        camera_noise: of a rotation of a frame, degrees.
    """
    rng = np.random.default_rng([seed, 98])
    path = path or handheld_path(9.0, seed)
    cam_from_imu, offset = exponential(rng.standard_normal((1, 3)))[0], rng.uniform(-1, 1)
    recording = simulate_imu(
        path, cam_from_imu=cam_from_imu, time_offset=offset, gyroscope_bias=BIAS, noise=noise, seed=seed
    )
    rotations = path.motion(FRAMES).world_from_cam
    rotations = rotations @ exponential(np.radians(camera_noise) * rng.standard_normal((len(FRAMES), 3)))
    return replace(recording, cam_from_imu=None, time_offset=None), rotations, cam_from_imu, offset


def turning(vectors):
    """A path that only turns, from a function of time to rotation vectors (n, 3)."""
    time = np.arange(0.0, 9.01, 0.05)
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(v), np.zeros(3)).inverse() for v in vectors(time)]
    return SmoothPath(time, poses)


def test_exact_samples_give_the_exact_mounting():
    recording, rotations, cam_from_imu, offset = problem(0)
    timing = fit_timing(recording, FRAMES, rotations)
    assert timing.time_offset == pytest.approx(offset, abs=2e-6)
    assert np.linalg.norm(logarithm((timing.cam_from_imu @ cam_from_imu.T)[None])) < 1e-4
    np.testing.assert_allclose(timing.gyroscope_bias, BIAS, atol=1e-4)
    assert timing.correlation > 0.999999
    applied = timing.applied(recording)
    assert applied.time_offset == timing.time_offset
    np.testing.assert_array_equal(applied.cam_from_imu, timing.cam_from_imu)


def test_errors_are_covered_by_their_standard_deviations():
    """Twenty draws with a phone's noise and 0.1 degrees in every frame."""
    offsets, turns = [], []
    for seed in range(20):
        recording, rotations, cam_from_imu, offset = problem(seed, ImuNoise(), 0.1)
        timing = fit_timing(recording, FRAMES, rotations)
        turn = logarithm((cam_from_imu @ timing.cam_from_imu.T)[None])[0]
        assert abs(timing.time_offset - offset) < 0.005
        assert np.degrees(np.linalg.norm(turn)) < 0.5
        offsets.append((timing.time_offset - offset) / timing.time_offset_sigma)
        turns.append(turn @ np.linalg.solve(timing.rotation_covariance, turn) / 3)
    assert max(np.abs(offsets)) < 3.0
    assert 0.6 < np.sqrt(np.mean(np.square(offsets))) < 1.5
    assert 0.3 < np.mean(turns) < 1.6


def test_clocks_that_do_not_overlap_are_taken_to_start_together():
    recording, rotations, _, offset = problem(1)
    elsewhere = replace(recording, time=recording.time + 1.4e9)
    assert fit_timing(elsewhere, FRAMES - 2.0, rotations).time_offset == pytest.approx(offset - 2.0 - 1.4e9, abs=1e-5)


def test_frames_without_a_rotation_are_left_out():
    recording, rotations, _, offset = problem(2)
    rotations[20:60] = np.nan
    assert fit_timing(recording, FRAMES, rotations).time_offset == pytest.approx(offset, abs=1e-5)


def test_a_known_mounting_is_held():
    recording, rotations, cam_from_imu, offset = problem(3, ImuNoise(), 0.05)
    known = replace(recording, cam_from_imu=cam_from_imu, time_offset=offset)
    timing = fit_timing(known, FRAMES, rotations)
    assert (timing.time_offset, timing.time_offset_sigma, timing.rotation_sigma) == (offset, 0.0, 0.0)
    np.testing.assert_array_equal(timing.cam_from_imu, cam_from_imu)
    np.testing.assert_allclose(timing.gyroscope_bias, BIAS, atol=1e-3)


def test_another_recording_is_refused():
    recording, *_ = problem(4)
    _, rotations, *_ = problem(5)
    with pytest.raises(ReconstructionError, match=r"correlation of its angular velocity .* is 0\.\d\d at best"):
        fit_timing(replace(recording, time_offset=0.0), FRAMES, rotations)
    with pytest.raises(ReconstructionError, match="the gyroscope does not fit the video"):
        fit_timing(recording, FRAMES, rotations)


def test_a_known_offset_that_is_wrong_is_refused():
    recording, rotations, _, offset = problem(4)
    with pytest.raises(ReconstructionError, match="the gyroscope does not fit the video"):
        fit_timing(replace(recording, time_offset=offset + 0.5), FRAMES, rotations)


def test_turning_about_one_axis_leaves_the_rotation_open():
    path = turning(lambda t: 0.2 * (np.sin(2.1 * t) + np.sin(4.7 * t + 1))[:, None] * [0.0, 1.0, 0.0])
    recording, rotations, cam_from_imu, offset = problem(6, ImuNoise(), 0.05, path)
    with pytest.raises(ReconstructionError, match=r"axis \(-?0\.00, -?1\.00, -?0\.00\) is \d+ degrees.*must be given"):
        fit_timing(recording, FRAMES, rotations)
    timing = fit_timing(replace(recording, cam_from_imu=cam_from_imu), FRAMES, rotations)
    assert timing.time_offset == pytest.approx(offset, abs=2e-3)


def test_a_motion_that_repeats_leaves_the_offset_open():
    path = turning(lambda t: 0.1 * np.column_stack([np.sin(6 * t), np.cos(6 * t), np.sin(6 * t + 1)]))
    recording, rotations, *_ = problem(7, ImuNoise(), 0.05, path)
    with pytest.raises(ReconstructionError, match="the time offset of the IMU is open"):
        fit_timing(recording, FRAMES, rotations)


def test_a_camera_that_hardly_turns_is_refused():
    recording, rotations, *_ = problem(8, ImuNoise(), 0.05, handheld_path(9.0, 8, turn=1e-4))
    with pytest.raises(ReconstructionError, match=r"the camera's own changes by 0\.\d+ deg/s"):
        fit_timing(recording, FRAMES, rotations)


def test_a_recording_of_other_seconds_is_refused():
    recording, rotations, *_ = problem(9)
    short = replace(recording, **{k: getattr(recording, k)[:200] for k in ("time", "gyroscope", "accelerometer")})
    with pytest.raises(InputError, match=r"the recording of the IMU covers .* of (its clock|the frames)"):
        fit_timing(short, FRAMES, rotations)
    with pytest.raises(InputError, match="5 frames with a rotation are too few"):
        fit_timing(recording, FRAMES[:5], rotations[:5])
    with pytest.raises(InputError, match="the times of the frames do not ascend"):
        fit_timing(recording, FRAMES[::-1], rotations)
    with pytest.raises(InputError, match="times and rotations have the shapes"):
        fit_timing(recording, FRAMES[1:], rotations)
