from dataclasses import replace

import numpy as np
import pytest

from factorsfm.inertial.alignment import VisualPoses, align_inertial
from factorsfm.inertial.recording import GRAVITY, ImuNoise
from factorsfm.inertial.timing import fit_timing
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.rotations import exponential
from factorsfm.synthetic.imu import handheld_path, simulate_imu
from tests.inertial_problems import METRES_PER_UNIT, angle, inertial_problem


def test_exact_samples_give_exact_scale_gravity_and_velocities():
    """What is left comes from the samples between which the acceleration is interpolated."""
    problem = inertial_problem(0, noisy=False)
    found = align_inertial(problem.recording, problem.poses)
    assert found.scale == pytest.approx(METRES_PER_UNIT, rel=2e-4)
    assert angle(found.gravity, problem.gravity) < 0.005
    assert angle(found.up, -problem.gravity) < 0.005
    np.testing.assert_allclose(found.velocities, problem.motion.velocity, atol=2e-4)
    np.testing.assert_allclose(found.gyroscope_bias, 0.0, atol=1e-5)
    np.testing.assert_allclose(found.accelerometer_bias, 0.0, atol=1e-3)
    assert found.free_gravity == pytest.approx(GRAVITY, abs=5e-3)


def test_errors_are_covered_by_their_standard_deviations():
    """Twenty handheld paths with a phone's noise: scale, direction of gravity, biases."""
    scales, gravities, chi, misfits = [], [], [], []
    for seed in range(20):
        problem = inertial_problem(seed)
        found = align_inertial(problem.recording, problem.poses)
        scale = np.log(found.scale / METRES_PER_UNIT)
        scales.append((scale, scale / found.log_scale_sigma))
        off = angle(found.gravity, problem.gravity)
        gravities.append((off, np.radians(off) / found.gravity_sigma))
        biases = found.accelerometer_bias - problem.accelerometer_bias, found.gyroscope_bias - problem.gyroscope_bias
        error, rows = np.concatenate([[scale], *biases]), [0, *range(4, 10)]
        chi.append(error @ np.linalg.solve(found.covariance[np.ix_(rows, rows)], error) / 7)
        misfits.append(found.misfit)
        assert np.linalg.norm(found.gravity) == pytest.approx(GRAVITY)
    (scale, by_sigma), (off, off_by_sigma) = np.abs(scales).T, np.transpose(gravities)
    assert 0.002 < np.median(scale) < 0.008
    assert scale.max() < 0.02
    assert off.max() < 0.5
    assert max(by_sigma.max(), off_by_sigma.max()) < 3.0
    assert 0.7 < np.sqrt(np.mean(by_sigma**2)) < 1.4
    assert 0.7 < np.mean(chi) < 1.4
    assert 0.8 < np.mean(misfits) < 1.1


def test_biases_that_walk_are_expected_to():
    """An accelerometer whose bias wanders by some 0.07 m/s^2: taken for constant, the misfit would be above 4."""
    noise, misfits, off = ImuNoise(accelerometer_walk=0.03), [], []
    for seed in range(8):
        problem = inertial_problem(seed, noise=noise)
        found = align_inertial(problem.recording, problem.poses)
        misfits.append(found.misfit)
        off.append(np.radians(angle(found.gravity, problem.gravity)) / found.gravity_sigma)
    assert 0.7 < np.mean(misfits) < 1.3
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.6


@pytest.mark.parametrize("seed", range(3))
def test_an_imu_whose_clock_and_axes_are_unknown(seed):
    """The mounting from frames at 30 per second, the lever arm given, then scale and gravity."""
    problem = inertial_problem(seed)
    path, rng = handheld_path(6.0, seed), np.random.default_rng(seed)
    recording = simulate_imu(
        path,
        gravity=problem.gravity,
        gyroscope_bias=problem.gyroscope_bias,
        accelerometer_bias=problem.accelerometer_bias,
        cam_from_imu=exponential(rng.standard_normal((1, 3)))[0],
        lever_arm=[0.05, -0.03, 0.01],
        time_offset=0.7,
        noise=ImuNoise(),
        seed=seed,
    )
    frames = np.arange(0, 6, 1 / 30)
    rotations = path.motion(frames).world_from_cam @ exponential(np.radians(0.02) * rng.standard_normal((180, 3)))
    timing = fit_timing(replace(recording, cam_from_imu=None, time_offset=None), frames, rotations)
    # The recording may miss the first keyframe by the error of the offset.
    found = align_inertial(timing.applied(recording), without_the_first(problem.poses, 1))
    assert abs(np.log(found.scale / METRES_PER_UNIT)) < 0.02
    assert angle(found.gravity, problem.gravity) < 0.5


def test_errors_that_are_larger_than_stated_widen_the_covariance():
    problem = inertial_problem(1)
    honest = align_inertial(problem.recording, problem.poses)
    bold = replace(problem.poses, covariance=problem.poses.covariance / 9)
    found = align_inertial(problem.recording, bold)
    assert 4.0 < found.misfit < 9.5
    assert found.log_scale_sigma == pytest.approx(honest.log_scale_sigma, rel=0.3)


def test_a_map_may_be_in_any_unit_and_world():
    problem = inertial_problem(2)
    honest = align_inertial(problem.recording, problem.poses)
    turn, unit = exponential(np.array([[1.0, -0.5, 2.0]]))[0], 1e-4
    poses = VisualPoses(
        problem.poses.time,
        turn @ problem.poses.world_from_cam,
        unit * problem.poses.center @ turn.T + 3.0,
        problem.poses.covariance * np.outer(np.repeat([1, unit], 3), np.repeat([1, unit], 3)),
    )
    found = align_inertial(problem.recording, poses)
    assert found.scale == pytest.approx(honest.scale / unit, rel=1e-4)
    assert found.log_scale_sigma == pytest.approx(honest.log_scale_sigma, rel=1e-3)
    np.testing.assert_allclose(found.gravity, turn @ honest.gravity, atol=1e-3)


def test_a_camera_that_hardly_accelerates_leaves_the_scale_open():
    """Swings of a centimetre where a position is known to 2 mm."""
    problem = inertial_problem(3, reach=0.01)
    noise = 2e-3 / METRES_PER_UNIT
    covariance = np.tile(np.diag(np.repeat([np.radians(0.02), noise], 3) ** 2), (20, 1, 1))
    centers = problem.poses.center + noise * np.random.default_rng(1).standard_normal((20, 3))
    with pytest.raises(ReconstructionError, match=r"does not determine the metric scale: .* is \d+ %, at most 10 %"):
        align_inertial(problem.recording, replace(problem.poses, center=centers, covariance=covariance))


def without_the_first(poses, count):
    return VisualPoses(*(getattr(poses, k)[count:] for k in ("time", "world_from_cam", "center", "covariance")))


@pytest.mark.parametrize(
    ("offset", "message"),
    [
        (0.1, r"contradicts the motion of the camera: their differences are \d+\.\d times as large as expected"),
        (0.6, r"have a correlation of -0\.\d\d, near 1 is expected"),
    ],
)
def test_a_wrong_clock_is_refused(offset, message):
    problem = inertial_problem(4)
    late = replace(problem.recording, time_offset=offset)
    with pytest.raises(ReconstructionError, match=message):
        align_inertial(late, without_the_first(problem.poses, 3))


def test_another_gravity_is_refused():
    """An accelerometer whose unit is wrong by a third, in a map whose scale nothing else tells."""
    problem = inertial_problem(6)
    wrong = replace(problem.recording, accelerometer=problem.recording.accelerometer * 0.7)
    with pytest.raises(ReconstructionError, match=r"they show a gravity of 6\.\d\d m/s\^2 .* 9.81 is expected"):
        align_inertial(wrong, problem.poses)


def test_wrong_axes_are_refused():
    problem = inertial_problem(5)
    turned = replace(problem.recording, cam_from_imu=exponential(np.array([[0.0, 0.0, np.pi / 2]]))[0])
    with pytest.raises(ReconstructionError):
        align_inertial(turned, problem.poses)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"center": np.zeros((3, 3))}, r'"center" of keyframes has the shape \(3, 3\); \(20, 3\) is expected'),
        ({"center": np.full((20, 3), np.nan)}, '"center" of keyframes holds values that are not finite'),
        ({"time": np.zeros(20)}, "the times of keyframes do not ascend"),
        ({"covariance": np.tile(-np.eye(6), (20, 1, 1))}, "has a negative eigenvalue"),
    ],
)
def test_keyframes_that_cannot_be_are_refused(changed, message):
    poses = inertial_problem(0).poses
    with pytest.raises(InputError, match=message):
        replace(poses, **changed)


def test_too_few_keyframes_are_refused():
    poses = inertial_problem(0).poses
    with pytest.raises(InputError, match="4 keyframes are given; an IMU needs at least 5"):
        VisualPoses(*(getattr(poses, k)[:4] for k in ("time", "world_from_cam", "center", "covariance")))
