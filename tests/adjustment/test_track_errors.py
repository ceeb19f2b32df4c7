from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.track_errors import STRETCH, measure_track_errors
from factorsfm.support.options import PolishOptions
from tests.calibration import assert_calibrated, normalised, pose_errors, unit_direction, without_unit
from tests.estimation_problems import angles_between, in_unit_of, make_problem

OPTIONS = PolishOptions(iterations=30, tolerance=1e-10, point_sigma=1e3)
WHITE = 0.1  # pixels


def drawn(observations, persistent, seed=0):
    """(m, 2) errors in pixels of the model itself; `persistent`: (n,) standard deviation of each track."""
    o, rng = observations, np.random.default_rng([seed, 11])
    stretches = int(o.frame.max()) // STRETCH + 1
    offset = rng.standard_normal((len(persistent), stretches, 2)) * np.asarray(persistent)[:, None, None]
    return offset[o.point, o.frame // STRETCH] + WHITE * rng.standard_normal((len(o.point), 2))


def with_errors(problem, error):
    o = problem.observations
    return Observations(o.frame, o.point, o.pixels + error)


@pytest.fixture(scope="module")
def shot():
    return make_problem("truck", frames=40, points=60, parallax=0.2)


def test_what_persists_is_measured():
    frames, tracks = 160, 60
    o = Observations(np.tile(np.arange(frames), tracks), np.repeat(np.arange(tracks), frames), np.zeros((9600, 2)))
    sizes = np.repeat([0.0, 0.1, 0.3], tracks // 3)
    errors = measure_track_errors(drawn(o, sizes), o, 1e3)
    assert errors.sigma == pytest.approx(WHITE, rel=0.05)
    ratio = errors.shared / (1.0 - STRETCH * errors.shared)  # with unit weights
    measured = WHITE * np.sqrt(ratio.reshape(tracks, -1)[:, 0].reshape(3, -1).mean(1))
    assert measured[0] < 0.04
    assert measured[1] == pytest.approx(0.1, rel=0.05)
    assert measured[2] == pytest.approx(0.3, rel=0.15)


def test_of_independent_errors_hardly_anything_is_taken_for_persistent(shot):
    o = shot.observations
    error = drawn(o, np.zeros(len(shot.points)))
    errors = measure_track_errors(error, o, 2.0)
    assert 0.03 < (errors.shared * STRETCH).mean() < 0.15
    assert errors.sigma == pytest.approx(WHITE, rel=0.02)


def problem_with_persistent_errors(shot, size, seed=0):
    rng = np.random.default_rng([seed, 5])
    error = drawn(shot.observations, size * rng.choice([0.1, 1.0], len(shot.points)), seed)
    error[::50] += 2.0  # outliers
    seen = with_errors(shot, error)
    errors = measure_track_errors(error, seen, 2.0)
    return BundleAdjustment(shot.truth, seen, OPTIONS, ErrorModel(errors.sigma, errors))


def test_the_gradient_is_that_of_the_cost(shot):
    adjustment = problem_with_persistent_errors(shot, 0.3)
    normal, step = adjustment._linearize(), 1e-6
    cameras, points = np.zeros(adjustment.columns.size), np.zeros((len(shot.points), 3))
    for column in (6, 9, 100, 200, 238):
        cameras[column] = step
        costs = [adjustment._cost(adjustment._retract(sign * cameras, points)) for sign in (1.0, -1.0)]
        cameras[column] = 0.0
        assert (costs[0] - costs[1]) / (2 * step) == pytest.approx(normal.camera_gradient[column], rel=1e-7)
    for point, axis in ((0, 0), (7, 1), (30, 2)):
        points[point, axis] = step
        costs = [adjustment._cost(adjustment._retract(cameras, sign * points)) for sign in (1.0, -1.0)]
        points[point, axis] = 0.0
        # What holds the point near its start is not part of the gradient at the start.
        assert (costs[0] - costs[1]) / (2 * step) == pytest.approx(normal.point_gradient[point, axis], rel=1e-6)


def test_the_normal_equations_are_those_of_the_dense_information_matrix(shot):
    adjustment = problem_with_persistent_errors(shot, 0.3)
    errors, normal = adjustment.errors.tracks, adjustment._linearize()
    term, c = normal.terms[0], adjustment.columns.size
    m = len(term.point)
    jacobian = np.zeros((2, m, c + 3 * len(shot.points)))
    for k in range(m):
        jacobian[:, k, term.columns[k]] = term.by_camera[:, :, k].T
        jacobian[:, k, c + 3 * term.point[k] : c + 3 * term.point[k] + 3] = term.by_point[:, :, k].T
    weight = np.eye(m)
    for g, first in enumerate(errors.first):
        rows = np.arange(first, first + np.sum(errors.stretch == g))
        root = errors.root_weight[rows]
        weight[np.ix_(rows, rows)] -= errors.shared[g] * np.outer(root, root)
    dense = sum(jacobian[d].T @ weight @ jacobian[d] for d in range(2))
    scale = np.abs(dense).max()
    np.testing.assert_allclose(normal.camera, dense[:c, :c], atol=1e-14 * scale)
    for j in range(len(shot.points)):
        here = slice(c + 3 * j, c + 3 * j + 3)
        np.testing.assert_allclose(normal.point[j], dense[here, here], atol=1e-14 * scale)
    for cross, columns, points in adjustment._elimination.cross_blocks(normal):
        expected = dense[np.ix_(columns, c + (3 * points[:, None] + np.arange(3)).ravel())]
        np.testing.assert_allclose(cross, expected, atol=1e-14 * scale)


def test_cameras_are_better_and_their_covariance_is_calibrated(shot):
    """Beside least squares that take the errors of a track as independent, and promise too much."""
    options = replace(OPTIONS, tolerance=1e-5)
    errors = {"independent": [], "persistent": []}
    normalised_errors = {"independent": [], "persistent": []}
    for seed in range(4):
        rng = np.random.default_rng([seed, 5])
        seen = with_errors(shot, drawn(shot.observations, 0.5 * rng.choice([0.05, 1.0], len(shot.points)), seed))
        plain = BundleAdjustment(shot.truth, seen, options, ErrorModel(WHITE))
        plain.solve()
        measured = measure_track_errors(plain.reprojection_vectors(), seen, 100.0)
        aware = BundleAdjustment(plain.state, seen, options, ErrorModel(measured.sigma, measured))
        aware.solve()
        for kind, adjustment in (("independent", plain), ("persistent", aware)):
            state = in_unit_of(adjustment.state, shot.truth)
            errors[kind].append(np.sqrt((angles_between(state.rotation, shot.truth.rotation) ** 2).mean()))
            covariance = adjustment.marginals().camera[6 : 6 * shot.frames, 6 : 6 * shot.frames]
            free = without_unit(pose_errors(state, shot.truth), covariance, unit_direction(state))
            normalised_errors[kind].append(normalised(*free))
    assert 0.35 < np.mean(errors["persistent"]) / np.mean(errors["independent"]) < 0.6
    assert_calibrated(normalised_errors["persistent"])
    total, freedom = np.sum(normalised_errors["independent"], axis=0)
    assert 1.2 < total / freedom < 1.5


def test_without_what_persists_the_weights_are_those_of_the_kernel(shot):
    o = shot.observations
    seen = with_errors(shot, drawn(o, np.zeros(len(shot.points))))
    plain = BundleAdjustment(shot.truth, seen, OPTIONS, ErrorModel(WHITE))
    errors = measure_track_errors(plain.reprojection_vectors(), seen, OPTIONS.kernel)
    independent = replace(errors, sigma=WHITE, shared=np.zeros_like(errors.shared))
    weighted = BundleAdjustment(shot.truth, seen, OPTIONS, ErrorModel(WHITE, independent))
    expected, found = plain._linearize(), weighted._linearize()
    np.testing.assert_allclose(found.camera, expected.camera, rtol=0.01, atol=0.004 * np.abs(expected.camera).max())
