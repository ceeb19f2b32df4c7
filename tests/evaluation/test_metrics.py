"""Alignment and metrics against hand-computed values and against evo."""

import numpy as np
import pycolmap
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from numpy.testing import assert_allclose

from factorsfm.evaluation.metrics import (
    ATE_THRESHOLDS,
    R_RPE_THRESHOLDS,
    T_RPE_THRESHOLDS,
    DepthErrors,
    auc,
    parallax,
    point_depth_errors,
    recall_curve,
    relative_pose_errors,
    rotation_angle,
    trajectory_errors,
)
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import align, pose_arrays


def rotation(axis, degrees):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    half = np.radians(degrees) / 2
    return pycolmap.Rotation3d(np.append(np.sin(half) * axis, np.cos(half))).matrix()


def random_rotations(rng, n):
    return np.array([rotation(rng.standard_normal(3), rng.uniform(0, 180)) for _ in range(n)])


def moved(rotations, centers, scale, turn, shift):
    """The estimate whose alignment to (rotations, centers) is the inverse of this similarity."""
    return turn @ rotations, scale * centers @ turn.T + shift


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def trajectory(rng):
    return random_rotations(rng, 12), rng.standard_normal((12, 3))


TURN = rotation([1, 2, -1], 70)
SHIFT = np.array([3.0, -2.0, 5.0])


def test_align_recovers_a_similarity(trajectory):
    rotations, centers = trajectory
    estimate = moved(rotations, centers, 4.0, TURN, SHIFT)
    alignment = align(*estimate, rotations, centers)
    assert alignment.scale == pytest.approx(0.25, abs=1e-12)
    assert_allclose(alignment.rotation, TURN.T, atol=1e-12)
    assert_allclose(alignment.points(estimate[1]), centers, atol=1e-12)
    assert_allclose(alignment.rotations(estimate[0]), rotations, atol=1e-12)


def test_align_ignores_unregistered_frames(trajectory):
    rotations, centers = trajectory
    estimate = moved(rotations, centers, 4.0, TURN, SHIFT)
    estimate[1][[0, 5]] = np.nan
    alignment = align(*estimate, rotations, centers)
    assert alignment.scale == pytest.approx(0.25, abs=1e-12)
    assert_allclose(alignment.rotation, TURN.T, atol=1e-12)


def test_align_never_mirrors(trajectory):
    rotations, centers = trajectory
    alignment = align(rotations, centers * [1, 1, -1], rotations, centers)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(alignment.points(centers * [1, 1, -1]) - centers).max() > 0.1


@pytest.mark.parametrize("direction", [[1, 0, 0], [1, -2, 3]])
def test_align_collinear_centres_by_orientation(rng, direction):
    rotations = random_rotations(rng, 8)
    centers = np.linspace(0, 1, 8)[:, None] * np.asarray(direction, float) + SHIFT
    estimate = moved(rotations, centers, 0.5, TURN, -SHIFT)
    alignment = align(*estimate, rotations, centers)
    assert alignment.scale == pytest.approx(2.0, rel=1e-12)
    assert_allclose(alignment.rotation, TURN.T, atol=1e-10)


def test_align_collinear_truth_with_noisy_estimate(rng):
    """Noise off the line must not decide the turn about it."""
    rotations = random_rotations(rng, 8)
    centers = np.linspace(0, 1, 8)[:, None] * [0.0, 0.0, 1.0]
    noisy = centers + 1e-3 * rng.standard_normal((8, 3))
    alignment = align(*moved(rotations, noisy, 1.0, TURN, SHIFT), rotations, centers)
    assert rotation_angle(alignment.rotation, TURN.T) < 0.2  # degrees: 1e-3 along a line of length 1


def test_align_two_frames(rng):
    rotations, centers = random_rotations(rng, 2), np.array([[0.0, 0, 0], [0, 0, 2]])
    alignment = align(*moved(rotations, centers, 2.0, TURN, SHIFT), rotations, centers)
    assert alignment.scale == pytest.approx(0.5, rel=1e-12)
    assert_allclose(alignment.rotation, TURN.T, atol=1e-10)


@pytest.mark.parametrize("frames", [1, 5])
def test_align_without_motion(rng, frames):
    """One frame, or a tripod: orientations give the rotation, the scale stays 1."""
    rotations, centers = random_rotations(rng, frames), np.repeat(SHIFT[None], frames, axis=0)
    alignment = align(*moved(rotations, centers, 7.0, TURN, SHIFT), rotations, centers)
    assert alignment.scale == 1.0
    assert_allclose(alignment.rotation, TURN.T, atol=1e-10)
    assert_allclose(alignment.points(7.0 * centers @ TURN.T + SHIFT), centers, atol=1e-12)


def test_moving_estimate_of_a_static_truth_is_punished(rng):
    """A free scale would shrink any invented motion to nothing."""
    rotations, centers = np.repeat(np.eye(3)[None], 2, axis=0), np.zeros((2, 3))
    errors = trajectory_errors(rotations, np.array([[0.0, 0, 0], [1, 0, 0]]), rotations, centers)
    assert_allclose(errors.ate, [0.5, 0.5], atol=1e-12)
    assert_allclose(errors.t_rpe, [1.0], atol=1e-12)


def test_align_with_given_scale(trajectory):
    rotations, centers = trajectory
    estimate = moved(rotations, centers, 4.0, TURN, SHIFT)
    alignment = align(*estimate, rotations, centers, scale=0.5)
    assert alignment.scale == 0.5
    assert_allclose(alignment.points(estimate[1]).mean(axis=0), centers.mean(axis=0), atol=1e-12)


def test_align_refuses_bad_input(trajectory):
    rotations, centers = trajectory
    nothing = np.full_like(centers, np.nan)
    with pytest.raises(InputError, match="no frame is registered"):
        align(rotations, nothing, rotations, centers)
    with pytest.raises(InputError, match=r"centers have the shape \(11, 3\)"):
        align(rotations, centers[1:], rotations, centers)
    with pytest.raises(InputError, match="not finite"):
        align(rotations, centers, rotations, nothing)


def test_pose_arrays(trajectory):
    rotations, centers = trajectory
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(r), c).inverse() for r, c in zip(rotations, centers, strict=True)]
    found_rotations, found_centers = pose_arrays([poses[0], None, *poses[2:]])
    assert_allclose(np.delete(found_rotations, 1, 0), np.delete(rotations, 1, 0), atol=1e-12)
    assert_allclose(np.delete(found_centers, 1, 0), np.delete(centers, 1, 0), atol=1e-12)
    assert np.isnan(found_rotations[1]).all()
    assert np.isnan(found_centers[1]).all()


def test_trajectory_errors_by_hand():
    """The middle camera of three is 6 mm too high and turned by 2 degrees, scale given."""
    rotations = np.repeat(rotation([0, 1, 0], 30)[None], 3, axis=0)
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    wrong_rotations, wrong_centers = rotations.copy(), centers.copy()
    wrong_rotations[1] = rotations[1] @ rotation([1, 0, 0], 2)
    wrong_centers[1, 1] += 0.006
    errors = trajectory_errors(wrong_rotations, wrong_centers, rotations, centers, scale=1.0)
    # The mean moves by 2 mm; the rotation stays, since truth on a line follows the orientations by 2/3 degree
    # about that line only, which moves no centre by more than 0.1 mm.
    assert_allclose(errors.ate, [0.002, 0.004, 0.002], atol=1e-4)
    assert_allclose(errors.r_rpe, [2.0, 2.0], atol=1e-9)
    # From 0 to 1 the move is wrong by 6 mm; from 1 to 2 it is also seen from a turned camera.
    assert errors.t_rpe[0] == pytest.approx(0.006, rel=1e-9)
    seen = wrong_rotations[1].T @ [1, -0.006, 0] - rotations[1].T @ [1, 0, 0]
    assert errors.t_rpe[1] == pytest.approx(np.linalg.norm(seen), rel=1e-9)


def test_errors_are_inf_where_unregistered(trajectory):
    rotations, centers = trajectory
    missing = centers.copy()
    missing[3] = np.nan
    errors = trajectory_errors(rotations, missing, rotations, centers)
    assert np.flatnonzero(np.isinf(errors.ate)).tolist() == [3]
    assert np.flatnonzero(np.isinf(errors.t_rpe)).tolist() == [2, 3]
    assert np.flatnonzero(np.isinf(errors.r_rpe)).tolist() == [2, 3]
    assert errors.ate[np.isfinite(errors.ate)].max() < 1e-12
    assert auc(errors.ate, ATE_THRESHOLDS[0]) == pytest.approx(100 * 11 / 12, abs=1e-6)


def test_errors_without_any_registered_frame(trajectory):
    rotations, centers = trajectory
    errors = trajectory_errors(rotations, np.full_like(centers, np.nan), rotations, centers)
    assert errors.alignment is None
    assert (len(errors.ate), len(errors.t_rpe), len(errors.r_rpe)) == (12, 11, 11)
    assert np.isinf(errors.ate).all()
    assert np.isinf(errors.t_rpe).all()
    assert np.isinf(errors.r_rpe).all()


def test_trajectory_errors_agree_with_evo(rng, trajectory):
    rotations, centers = trajectory
    noise = np.array([rotation(rng.standard_normal(3), rng.uniform(0, 2)) for _ in rotations])
    estimate = moved(rotations @ noise, centers + 0.05 * rng.standard_normal((12, 3)), 3.0, TURN, SHIFT)
    errors = trajectory_errors(*estimate, rotations, centers)

    def path(r, c):
        poses = np.tile(np.eye(4), (len(c), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = r, c
        return PosePath3D(poses_se3=list(poses))

    truth, aligned = path(rotations, centers), path(*estimate)
    aligned.align(truth, correct_scale=True)
    relations = evo_metrics.PoseRelation
    ate = evo_metrics.APE(relations.translation_part)
    t_rpe = evo_metrics.RPE(relations.translation_part, 1, evo_metrics.Unit.frames)
    r_rpe = evo_metrics.RPE(relations.rotation_angle_deg, 1, evo_metrics.Unit.frames)
    for metric, ours in ((ate, errors.ate), (t_rpe, errors.t_rpe), (r_rpe, errors.r_rpe)):
        metric.process_data((truth, aligned))
        assert_allclose(ours, metric.error, rtol=1e-6, atol=1e-9)
    assert errors.ate.mean() > 0.01


@pytest.mark.parametrize("degrees", [1e-7, 0.02, 45.0, 179.0])
def test_rotation_angle(degrees):
    assert rotation_angle(TURN, TURN @ rotation([1, 1, 0], degrees)) == pytest.approx(degrees, rel=1e-6)


def test_relative_pose_errors_by_hand():
    rotations = np.repeat(np.eye(3)[None], 4, axis=0)
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]])
    estimate_rotations, estimate = rotations.copy(), centers.copy()
    estimate_rotations[1] = rotation([1, 0, 0], 3)  # about the baseline: no direction changes
    estimate[2] = [1, 0.1, 0]
    estimate[3] = np.nan
    errors = relative_pose_errors(estimate_rotations, estimate, rotations, centers)
    tilt = np.degrees(np.arctan(0.1))
    # Pairs 01, 02, 03, 12, 13, 23; 1 and 2 share their true centre, so that only the rotation counts.
    assert_allclose(errors, [3.0, tilt, 180.0, 3.0, 180.0, 180.0], atol=1e-9)
    assert auc(errors, 20) == pytest.approx(100 * (2 * 17 / 20 + 1 - tilt / 20) / 6, abs=1e-9)


def test_relative_pose_errors_see_reversal_and_missing_motion():
    rotations = np.repeat(np.eye(3)[None], 2, axis=0)
    centers = np.array([[0.0, 0, 0], [0, 0, 1]])
    assert_allclose(relative_pose_errors(rotations, -centers, rotations, centers), [180.0])
    assert_allclose(relative_pose_errors(rotations, 0 * centers, rotations, centers), [180.0])
    assert_allclose(relative_pose_errors(rotations, 5 * centers, rotations, centers), [0.0])


def test_auc_by_hand():
    assert auc([0.0, 0.5, 1.0, np.inf], 1.0) == pytest.approx(37.5)
    assert auc([0.0], 1.0) == 100.0
    assert (ATE_THRESHOLDS, T_RPE_THRESHOLDS) == ((0.002, 0.02), (0.001, 0.005))
    assert R_RPE_THRESHOLDS == (0.02, 0.1)


def test_auc_is_the_area_under_the_recall_curve(rng):
    errors = np.append(rng.uniform(0, 2, 50), np.inf)
    middles = (np.arange(100_000) + 0.5) / 100_000
    assert auc(errors, 1.0) == pytest.approx(recall_curve(errors, middles).mean(), abs=1e-3)


def test_recall_curve_counts_errors_up_to_the_threshold():
    assert_allclose(recall_curve([0.1, 0.2, np.inf, 0.2], [0.0, 0.1, 0.2, 9.0]), [0, 25, 75, 75])


@pytest.mark.parametrize("errors", [[], [np.nan], [-1.0]])
def test_auc_refuses_bad_errors(errors):
    with pytest.raises(InputError, match="not negative"):
        auc(errors, 1.0)
    with pytest.raises(InputError, match="not negative"):
        recall_curve(errors, [1.0])


def test_auc_refuses_bad_threshold():
    with pytest.raises(InputError, match="threshold is 0"):
        auc([1.0], 0.0)


def test_parallax_counts_from_the_first_registered_camera():
    centers = np.array([[np.nan] * 3, [1.0, 0, 0], [1, 0.3, 0], [1, 0, -0.4]])
    assert parallax(centers, [2.0, 4.0, 8.0, np.nan, 0.0, -3.0]) == pytest.approx(0.1)
    with pytest.raises(InputError, match="0 cameras, 1 depths"):
        parallax(centers[:1], [1.0])


def test_point_depth_reads_the_nearest_pixel_of_a_smaller_map():
    """Every map pixel is the block of 3 x 3 image pixels around (3 u + 1, 3 v + 1)."""
    truth = np.full((4, 5), 2.0, np.float32)
    truth[:, 3] = 2.05
    xy = np.array([[8.4, 4.0], [8.6, 4.0], [11.4, 4.0], [11.6, 4.0], [-0.6, 4.0], [14.6, 4.0], [np.nan, 4.0]])
    errors = point_depth_errors(xy, np.ones(7), truth, (15, 12), scale=2.0)
    assert_allclose(errors.truth, [2.0, 2.05, 2.05, 2.0, np.nan, np.nan, np.nan], rtol=1e-6)
    assert_allclose(errors.estimate, 2.0)


def test_point_depth_leaves_depth_edges_out():
    truth = np.full((7, 9), 2.0, np.float32)
    truth[:, 5:] = 2.2
    truth[2, 1] = np.nan
    xy = np.stack(np.meshgrid(np.arange(9), [3]), axis=-1).reshape(-1, 2).astype(float)
    errors = point_depth_errors(xy, np.full(9, 2.0), truth, (9, 7))
    assert np.isnan(errors.truth).tolist() == [False] * 4 + [True] * 2 + [False] * 3
    at_hole = point_depth_errors(np.array([[1.0, 2.0], [2.0, 2.0]]), np.ones(2), truth, (9, 7))
    assert np.isnan(at_hole.truth).tolist() == [True, False]  # a hole is no edge


def test_depth_errors_by_hand():
    errors = DepthErrors(np.array([2.0, 2.1, 1.6, -1.0, 3.0]), np.array([2.0, 2.0, 2.0, 2.0, np.nan]))
    assert_allclose(errors.ratio, [1.0, 1.05, 1.25, np.inf, np.nan])
    assert_allclose(errors.absolute, [0.0, 0.1, 0.4, 3.0, np.nan])
    assert_allclose(errors.relative, [0.0, 0.05, 0.2, 1.5, np.nan])


def test_depth_summary():
    truth = np.full(4, 2.0)
    summary = DepthErrors.pool(
        [DepthErrors(np.array([2.005, 2.08]), truth[:2]), DepthErrors(np.array([1.7, 5.0]), truth[2:])]
    ).summary()
    assert summary["points"] == 4
    assert [summary[f"delta<{k}"] for k in ("1.05", "1.05^2", "1.05^3")] == [50, 50, 50]
    assert [summary[f"delta<{k}"] for k in ("1.25", "1.25^2", "1.25^3")] == [75, 75, 75]
    assert [summary[f"theta<{k}cm"] for k in (1, 2, 5, 10, 25)] == [25, 25, 25, 50, 50]
    assert summary["within 5%"] == 50


def test_depth_summary_without_points():
    summary = DepthErrors.pool([]).summary()
    assert summary["points"] == 0
    assert np.isnan(summary["within 5%"])


def test_point_depth_refuses_bad_shapes():
    with pytest.raises(InputError, match=r"points \(2, 2\) and depths \(3,\)"):
        point_depth_errors(np.zeros((2, 2)), np.zeros(3), np.ones((4, 4), np.float32), (4, 4))
    with pytest.raises(InputError, match="depth map has the shape"):
        point_depth_errors(np.zeros((2, 2)), np.zeros(2), np.ones(4, np.float32), (4, 4))
