from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, L, T, X

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free, Known
from factorsfm.graph.factors import (
    affine_of_native,
    camera_from_pose,
    native_affine,
    native_affine_noise,
    native_depth_factor,
    pose_from_camera,
    virtual_offset,
)
from factorsfm.support.options import PolishOptions
from tests.calibration import assert_calibrated, normalised, pose_errors, unit_direction, without_unit
from tests.estimation_problems import FIELD, angles_between, in_unit_of, make_problem, perturbed, with_prior

# A tight tolerance and hardly any prior on the points: the optimum is that of the reprojections (and the prior).
EXACT = PolishOptions(iterations=60, tolerance=1e-12, point_sigma=1e3)


def start_of(truth, seed=0, **how_far):
    """A start away from the truth, the prior's variables included."""
    return replace(
        perturbed(truth, seed, **how_far),
        scale=np.ones_like(truth.scale),
        shift=np.zeros_like(truth.shift),
        field=np.zeros_like(truth.field),
    )


def assert_cameras(state, truth, *, angle_rad, distance):
    state = in_unit_of(state, truth)
    assert angles_between(state.rotation, truth.rotation).max() < angle_rad
    assert np.linalg.norm(state.translation - truth.translation, axis=1).max() < distance


# --- the same optimum as GTSAM ----------------------------------------------------------------------------------


def gtsam_optimum(problem, prior, start, sigma, kernel):
    """The same problem on GTSAM's factors and solver: cost, rotations, translations, affines."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    robust = gtsam.noiseModel.mEstimator.Cauchy.Create(kernel)
    pixel_noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
    lens = gtsam.Cal3_S2(problem.focal, problem.focal, 0.0, 0.0, 0.0)
    o = problem.observations
    for k in range(problem.frames):
        values.insert(X(k), pose_from_camera(start.rotation[k], start.translation[k]))
    graph.add(gtsam.NonlinearEqualityPose3(X(0), values.atPose3(X(0))))
    for j, point in enumerate(start.points):
        values.insert(L(j), point)
    for k, j, pixel in zip(o.frame, o.point, o.pixels, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, pixel_noise, X(k), L(j), lens))
    values.insert(T(0), virtual_offset())
    graph.add(gtsam.NonlinearEqualityPose3(T(0), virtual_offset()))
    for i in range(len(start.scale)):
        values.insert(A(i), native_affine(1.0, 0.0))
        noise = native_affine_noise(prior.scale_sigma, prior.shift_sigma)
        graph.add(gtsam.PriorFactorCal3_S2(A(i), native_affine(1.0, 0.0), noise))
    for i, k, j, value, std in zip(
        prior.image, prior.frame, prior.point, prior.inverse_depth, prior.sigma, strict=True
    ):
        noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Diagonal.Sigmas(np.array([std, 1e6])))
        graph.add(native_depth_factor(X(k), T(0), L(j), A(i), value, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(300)
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    poses = [camera_from_pose(result.atPose3(X(k))) for k in range(problem.frames)]
    affines = [result.atCal3_S2(A(i)) for i in range(len(start.scale))]
    return graph.error(result), *(np.array(part) for part in zip(*poses, strict=True)), affines


@pytest.mark.parametrize("motion", ["truck", "handheld"])
def test_the_optimum_is_that_of_gtsam(motion):
    problem = make_problem(motion, frames=6, points=60, parallax=0.1, noise_px=0.3)
    problem.observations.pixels[::17] += 6.0  # outliers
    prior, truth = with_prior(problem, [0, 2, 5])
    prior = replace(prior, node_weights=np.zeros_like(prior.node_weights))
    start = start_of(truth)
    adjustment = BundleAdjustment(start, problem.observations, EXACT, ErrorModel(0.3), prior=prior)
    state = adjustment.solve()
    cost, rotation, translation, affines = gtsam_optimum(problem, prior, start, 0.3, EXACT.kernel)
    # What is left is the model error x / VIRTUAL_BASELINE of the native depth factor.
    assert adjustment.cost() == pytest.approx(cost, rel=5e-5)
    assert angles_between(state.rotation, rotation).max() < 3e-6
    np.testing.assert_allclose(state.translation, translation, atol=5e-6)
    np.testing.assert_allclose(state.scale, [affine_of_native(a)[0] for a in affines], atol=5e-5)
    np.testing.assert_allclose(state.shift, [affine_of_native(a)[1] for a in affines], atol=5e-5)


# --- derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", [2.0, 1e6])
def test_the_gradient_is_that_of_the_cost(kernel):
    problem = make_problem("handheld", frames=5, points=40, parallax=0.1, noise_px=1.0)
    prior, truth = with_prior(problem, [0, 3], smooth=0.1)
    state = replace(perturbed(truth), log_focal=truth.log_focal + 0.01)
    options = PolishOptions(kernel=kernel, point_sigma=0.1)
    adjustment = BundleAdjustment(
        start_of(truth), problem.observations, options, ErrorModel(0.5), prior=prior, free=Free(focal=True)
    )
    adjustment.state = state  # away from where the priors of the points are anchored
    normal = adjustment._linearize()
    size, n = len(normal.camera_gradient), len(problem.points)
    assert size == 6 * 5 + 1 + 6 + 2 * 2 + np.prod(FIELD)
    taking_part = np.delete(np.arange(size), adjustment.columns.lens)

    def slope(column, row=None):
        step, costs = 1e-6, []
        for sign in (1, -1):
            camera, point = np.zeros(size), np.zeros((n, 3))
            (camera if row is None else point[row])[column] = sign * step
            costs.append(adjustment._cost(adjustment._retract(camera, point)))
        return (costs[0] - costs[1]) / (2 * step)

    camera = [slope(column) for column in taking_part]
    np.testing.assert_allclose(normal.camera_gradient[taking_part], camera, rtol=1e-6, atol=1e-6 * np.abs(camera).max())
    assert (np.abs(camera) > 0.5).all()  # every one of them takes part
    assert not normal.camera_gradient[adjustment.columns.lens].any()
    points = np.array([[slope(column, row) for column in range(3)] for row in range(n)])
    np.testing.assert_allclose(normal.point_gradient, points, rtol=1e-6, atol=1e-6 * np.abs(points).max())


def test_the_step_solves_the_whole_system():
    """Eliminating the points gives the step of the full normal equations."""
    problem = make_problem("arc", frames=4, points=30, parallax=0.2, noise_px=0.5)
    prior, truth = with_prior(problem, [1, 2], smooth=0.1)
    adjustment = BundleAdjustment(
        start_of(truth), problem.observations, PolishOptions(), ErrorModel(0.5), prior=prior, free=Free(focal=True)
    )
    normal = adjustment._linearize()
    c, n = len(normal.camera_gradient), len(problem.points)
    full, gradient = np.zeros((c + 3 * n, c + 3 * n)), np.append(normal.camera_gradient, normal.point_gradient)
    full[:c, :c] = normal.camera
    for j in range(n):
        full[c + 3 * j : c + 3 * j + 3, c + 3 * j : c + 3 * j + 3] = normal.point[j]
    for term in normal.terms:
        for row, (columns, point) in enumerate(zip(term.columns, term.point, strict=True)):
            block = np.einsum("cd,pd->cp", term.by_camera[:, :, row], term.by_point[:, :, row])
            here = c + 3 * point + np.arange(3)
            np.add.at(full, (columns[:, None], here), block)
            np.add.at(full, (here[:, None], columns), block.T)
    free = np.delete(np.arange(c + 3 * n), [*range(6), *range(c)[adjustment.columns.lens]])
    mine = free[free < c]
    expected = -np.linalg.solve(full[np.ix_(free, free)], gradient[free])
    camera, point = adjustment._step(normal, adjustment._elimination.cross_blocks(normal), 0.0)
    np.testing.assert_array_equal(np.delete(camera, mine), 0.0)
    np.testing.assert_allclose(np.append(camera[mine], point), expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    inverse = np.linalg.inv(full[np.ix_(free, free)])
    chosen = np.array([0, 7, n - 1])
    marginals = adjustment.marginals()
    camera_covariance, covariance = marginals.camera, marginals.inverse_distances(chosen)
    cameras = inverse[: len(mine), : len(mine)]
    np.testing.assert_allclose(
        camera_covariance[np.ix_(mine, mine)], cameras, rtol=1e-7, atol=1e-11 * cameras.max()
    )  # fmt: skip
    rows = len(mine) + 3 * chosen + 2
    np.testing.assert_allclose(
        covariance, inverse[np.ix_(rows, rows)], rtol=1e-8, atol=1e-12 * inverse[rows, rows].max()
    )


# --- recovery ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["dolly", "truck", "handheld", "arc"])
def test_noise_free_shots_are_recovered_exactly(motion):
    problem = make_problem(motion)
    adjustment = BundleAdjustment(perturbed(problem.truth), problem.observations, EXACT, ErrorModel(0.25))
    state = adjustment.solve()
    assert_cameras(state, problem.truth, angle_rad=2e-10, distance=1e-8)
    assert np.median(adjustment.reprojection_errors()) < 1e-6
    state = in_unit_of(state, problem.truth)
    np.testing.assert_allclose(state.inverse_distance, problem.truth.inverse_distance, atol=2e-8)


def test_the_default_options_come_within_their_weak_prior():
    problem = make_problem("handheld", parallax=0.03)
    adjustment = BundleAdjustment(perturbed(problem.truth), problem.observations, PolishOptions(), ErrorModel(0.25))
    assert_cameras(adjustment.solve(), problem.truth, angle_rad=4e-6, distance=4e-6)


def test_pure_rotation_without_translation():
    problem = make_problem("rotation")
    start = perturbed(problem.truth, shift=0.0)
    adjustment = BundleAdjustment(start, problem.observations, EXACT, ErrorModel(0.25), free=Free(translation=False))
    state = adjustment.solve()
    assert angles_between(state.rotation, problem.truth.rotation).max() < 1e-13
    np.testing.assert_array_equal(state.translation, start.translation)
    np.testing.assert_allclose(state.bearing, problem.truth.bearing, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(state.inverse_distance, start.inverse_distance)  # says nothing, so it stays


def test_translation_is_held_where_asked():
    problem = make_problem("truck")
    start = perturbed(problem.truth)
    adjustment = BundleAdjustment(start, problem.observations, EXACT, ErrorModel(0.25), free=Free(translation=False))
    state = adjustment.solve()
    turned = state.rotation @ np.swapaxes(start.rotation, 1, 2)
    # The camera turns about its own centre.
    np.testing.assert_allclose(
        state.translation, np.einsum("kij,kj->ki", turned, start.translation), rtol=0.0, atol=1e-14
    )
    assert 0.02 < angles_between(state.rotation, start.rotation).max() < 0.12


@pytest.mark.parametrize("factor", [0.93, 1.08])
def test_the_focal_length_is_recovered(factor):
    problem = make_problem("arc", parallax=0.3, points=150)
    guess = replace(perturbed(problem.truth), log_focal=problem.truth.log_focal + np.log(factor))
    adjustment = BundleAdjustment(guess, problem.observations, EXACT, ErrorModel(0.25), free=Free(focal=True))
    state = adjustment.solve()
    np.testing.assert_allclose(np.exp(state.log_focal), problem.focal, rtol=2e-9)
    assert_cameras(state, problem.truth, angle_rad=2e-10, distance=1e-10)
    held = BundleAdjustment(guess, problem.observations, EXACT, ErrorModel(0.25))
    assert held.solve().log_focal == guess.log_focal
    assert held.cost() > 10.0
    assert adjustment.cost() < 1e-6 * held.cost()


def test_groups_of_focal_lengths_are_recovered():
    """Frames of three lenses, each with a guess of its own."""
    problem = make_problem("arc", parallax=0.3, points=150)
    group = np.array([1, 0, 2, 1, 1, 0, 2, 2, 0, 1])
    factor = np.array([0.93, 1.05, 1.1])
    guess = replace(perturbed(problem.truth), log_focal=problem.truth.log_focal + np.log(factor), group=group)
    adjustment = BundleAdjustment(guess, problem.observations, EXACT, ErrorModel(0.25), free=Free(focal=True))
    state = adjustment.solve()
    np.testing.assert_allclose(np.exp(state.log_focal), problem.focal, rtol=1e-9)
    np.testing.assert_array_equal(state.group, group)
    assert_cameras(state, problem.truth, angle_rad=2e-10, distance=1e-10)
    held = BundleAdjustment(guess, problem.observations, EXACT, ErrorModel(0.25))
    np.testing.assert_array_equal(held.solve().log_focal, guess.log_focal)


def test_what_is_known_of_the_focal_lengths_holds_them_together():
    """A tight random walk makes one focal length of many that are free."""
    problem = make_problem("arc", parallax=0.3, points=150, noise_px=0.3)
    k = problem.frames
    truth = replace(problem.truth, log_focal=np.repeat(problem.truth.log_focal, k), group=np.arange(k))
    step = np.diff(np.eye(k), axis=0)
    spreads = []
    for sigma in (1e3, 1e-7):
        adjustment = BundleAdjustment(
            truth,
            problem.observations,
            EXACT,
            ErrorModel(0.3),
            free=Free(focal=True),
            known=Known(focal=FocalPrior(truth.log_focal, step.T @ step / sigma**2)),
        )
        spreads.append(np.ptp(adjustment.solve().log_focal))
    assert 1e-3 < spreads[0] < 2e-3
    assert spreads[1] < 2e-10


def test_points_only_holds_the_cameras():
    problem = make_problem("truck")
    prior, truth = with_prior(problem, [0, 4], noise=0.0)
    start = replace(start_of(truth, angle_rad=0.0, shift=0.0), scale=truth.scale, shift=truth.shift)
    adjustment = BundleAdjustment(
        start, problem.observations, EXACT, ErrorModel(0.25), prior=prior, free=Free(cameras=False)
    )
    state = adjustment.solve()
    for name in ("rotation", "translation", "log_focal", "scale", "shift", "field"):
        np.testing.assert_array_equal(getattr(state, name), getattr(start, name))
    np.testing.assert_allclose(state.points, problem.points, rtol=0.0, atol=1e-11)


def test_the_prior_gives_depth_where_geometry_has_none():
    problem = make_problem("static", noise_px=0.1)
    prior, truth = with_prior(problem, [0, 5, 9], noise=0.01, scale_std=0.01, shift_std=0.01)
    adjustment = BundleAdjustment(start_of(truth), problem.observations, PolishOptions(), ErrorModel(0.1), prior=prior)
    state = in_unit_of(adjustment.solve(), truth)
    assert np.abs(state.inverse_distance - truth.inverse_distance).max() < 0.03
    assert 0.01 < np.abs(adjustment.prior_residuals()[0]).max() < 0.05
    assert np.linalg.norm(state.translation, axis=1).max() < 5e-4


def test_outliers_hardly_move_the_solution():
    problem = make_problem("handheld", points=150, noise_px=0.1)
    clean = BundleAdjustment(perturbed(problem.truth), problem.observations, EXACT, ErrorModel(0.1)).solve()
    rng = np.random.default_rng(5)
    wild = rng.random(len(problem.observations.pixels)) < 0.05
    problem.observations.pixels[wild] += problem.focal * rng.normal(0, 0.03, (wild.sum(), 2))
    robbed = BundleAdjustment(perturbed(problem.truth), problem.observations, EXACT, ErrorModel(0.1))
    state = robbed.solve()
    assert_cameras(clean, problem.truth, angle_rad=5e-4, distance=5e-4)
    assert_cameras(state, problem.truth, angle_rad=5e-4, distance=5e-4)
    assert np.median(robbed.reprojection_errors()[wild]) > 12.0


def test_reprojection_vectors_are_predicted_minus_observed():
    problem = make_problem("truck")
    problem.observations.pixels[3] += [6.0, -12.0]
    adjustment = BundleAdjustment(problem.truth, problem.observations, EXACT, ErrorModel(0.25))
    expected = np.zeros((len(problem.observations.pixels), 2))
    expected[3] = [-6.0, 12.0]
    np.testing.assert_allclose(adjustment.reprojection_vectors(), expected, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(adjustment.reprojection_errors(), np.linalg.norm(expected, axis=1), rtol=0.0, atol=1e-11)


def test_unsorted_observations_are_refused():
    problem = make_problem("truck")
    o = problem.observations
    backwards = Observations(o.frame[::-1], o.point[::-1], o.pixels[::-1])
    with pytest.raises(ValueError, match="sorted by point"):
        BundleAdjustment(problem.truth, backwards, EXACT, ErrorModel(0.25))


# --- uncertainty ------------------------------------------------------------------------------------------------

TRIALS = 60


def test_the_covariance_is_calibrated():
    """Against errors of simulated problems; the weak prior of the points is a measurement like the others here."""
    errors = {"poses": [], "points": [], "affines": [], "field": []}
    options = PolishOptions(kernel=1e6, tolerance=1e-5, point_sigma=0.1)
    for seed in range(TRIALS):
        problem = make_problem("handheld", frames=5, points=40, parallax=0.1, noise_px=0.3, seed=seed)
        prior, truth = with_prior(problem, [0, 2, 4], noise=0.03, smooth=0.05, seed=seed)
        n = len(problem.points)
        anchor_error = 0.1 * np.median(truth.inverse_distance) * np.random.default_rng([seed, 11]).standard_normal(n)
        start = replace(
            start_of(truth, seed, angle_rad=0.001, shift=0.003), inverse_distance=truth.inverse_distance + anchor_error
        )
        adjustment = BundleAdjustment(start, problem.observations, options, ErrorModel(0.3), prior=prior)
        state = adjustment.solve()
        some = np.arange(0, n, 5)
        marginals = adjustment.marginals()
        camera, points = marginals.camera, marginals.inverse_distances(some)
        columns = adjustment.columns
        moving = slice(6, columns.poses.stop)
        errors["poses"].append(normalised(pose_errors(state, truth), camera[moving, moving]))
        errors["points"].append(normalised((state.inverse_distance - truth.inverse_distance)[some], points))
        affine_error = np.stack([state.scale - truth.scale, state.shift - truth.shift], -1).ravel()
        errors["affines"].append(normalised(affine_error, camera[columns.affines, columns.affines]))
        errors["field"].append(normalised(state.field - truth.field, camera[columns.field, columns.field]))
        assert not camera[:6].any()
        assert not camera[columns.optics].any()  # the lens is fixed
    for trials in errors.values():
        assert_calibrated(trials)


@pytest.mark.parametrize("motion", ["truck", "dolly"])
def test_the_covariance_is_calibrated_up_to_the_unit(motion):
    """Geometry alone, default options: the unit of length is free, the weak prior of the points holds it loosely.

    The robust kernel makes Gaussian errors 1.09 times as large in variance, and its weights predict 1.38 times: with
    many observations the normalised error is 0.79, on the safe side.
    """
    poses, points = [], []
    for seed in range(TRIALS // 2):
        problem = make_problem(motion, frames=5, points=40, parallax=0.1, noise_px=0.3, seed=seed)
        truth = problem.truth
        start = perturbed(truth, seed, angle_rad=0.001, shift=0.003)
        adjustment = BundleAdjustment(start, problem.observations, PolishOptions(), ErrorModel(0.3))
        state = in_unit_of(adjustment.solve(), truth)
        some = np.arange(0, len(problem.points), 5)
        marginals = adjustment.marginals()
        camera, covariance = marginals.camera, marginals.inverse_distances(some)
        free = without_unit(pose_errors(state, truth), camera[6:30, 6:30], unit_direction(state))
        poses.append(normalised(*free))
        difference = (state.inverse_distance - truth.inverse_distance)[some]
        points.append(normalised(*without_unit(difference, covariance, state.inverse_distance[some])))
    assert_calibrated(poses, 0.79)
    assert_calibrated(points, 0.79)


def test_covariance_of_the_focal_length():
    """Its standard deviation against the spread of the estimates over simulated problems."""
    errors, deviations = [], []
    options = PolishOptions(kernel=1e6, tolerance=1e-6)
    for seed in range(40):
        problem = make_problem("arc", frames=5, points=40, parallax=0.3, noise_px=0.2, seed=seed)
        adjustment = BundleAdjustment(
            problem.truth, problem.observations, options, ErrorModel(0.2), free=Free(focal=True)
        )
        state = adjustment.solve()
        camera = adjustment.marginals().camera
        errors.append(state.log_focal[0] - problem.truth.log_focal[0])
        deviations.append(np.sqrt(camera[30, 30]))
    assert_calibrated([(e**2 / d**2, 1) for e, d in zip(errors, deviations, strict=True)])
