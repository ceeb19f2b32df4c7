import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factorsfm.graph.factors import camera_from_pose, image_reprojection_factor, pose_from_camera
from factorsfm.mapping.registration import _KERNEL, _align, register_image
from factorsfm.priors.affine import fit_affine
from factorsfm.priors.image_depth import ImageDepth
from tests.calibration import assert_calibrated, normalised
from tests.estimation_problems import angles_between, make_problem, rotation_matrices

SETTINGS = {"focal": 600.0, "sigma": 0.25, "inlier_px": 3.0}
ROTATION, TRANSLATION = rotation_matrices([0.05, -0.1, 0.03])[0], np.array([0.1, -0.05, 0.2])


def view(count=80, *, noise_px=0.0, seed=0, planar=False):
    """Points in front of the camera and their normalised observations."""
    rng = np.random.default_rng(seed)
    z = np.full(count, 3.0) if planar else rng.uniform(2, 8, count)
    q = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * z[:, None], z])
    observed = q[:, :2] / q[:, 2:] + noise_px / SETTINGS["focal"] * rng.standard_normal((count, 2))
    return (q - TRANSLATION) @ ROTATION, observed


def near():
    return rotation_matrices([0.01, 0.01, -0.005])[0] @ ROTATION, TRANSLATION + [0.03, -0.02, 0.03]


def far():
    """Looking the other way, from behind the points."""
    return rotation_matrices([0.0, 2.9, 0.4])[0], np.array([1.0, 2.0, 5.0])


def assert_pose(result, *, angle_rad, distance):
    assert angles_between(result.rotation[None], ROTATION[None])[0] < angle_rad
    assert np.linalg.norm(result.translation - TRANSLATION) < distance


# --- without depth ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [near, far])
@pytest.mark.parametrize("planar", [False, True])
def test_exact_observations_give_the_exact_pose(start, planar):
    points, observed = view(planar=planar)
    result = register_image(points, observed, *start(), **SETTINGS)
    assert_pose(result, angle_rad=1e-14, distance=1e-14)
    assert result.inliers.all()
    assert result.error == pytest.approx(0.0, abs=1e-12)
    assert result.affine is None


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_what_moves_by_itself_does_not_draw_the_pose(share):
    """From afar the kernel is wide, and its first minimum lies between the scene and what moves in it."""
    points, observed = view(400, noise_px=0.15)
    moves = observed[:, 0] < np.quantile(observed[:, 0], share)
    observed[moves] += [9.0 / SETTINGS["focal"], 0.0]
    result = register_image(points, observed, *near(), **SETTINGS)
    np.testing.assert_array_equal(result.inliers, ~moves)
    assert_pose(result, angle_rad=2e-4, distance=1e-3)


@pytest.mark.parametrize("start", [near, far])
@pytest.mark.parametrize("share", [0.1, 0.35])
def test_outliers_are_found(start, share):
    points, observed = view(200, noise_px=0.25)
    wild = np.zeros(200, bool)
    wild[: int(share * 200)] = True
    observed[wild] += np.random.default_rng(1).choice([-1, 1], (wild.sum(), 2)) * [0.1, 0.05]  # 60 and 30 pixels
    result = register_image(points, observed, *start(), **SETTINGS)
    np.testing.assert_array_equal(result.inliers, ~wild)
    assert_pose(result, angle_rad=3e-4, distance=7e-4)
    assert result.error == pytest.approx(0.25 * 1.18, rel=0.15)  # median of a Rayleigh distribution
    assert result.threshold == 3.0


def test_noise_is_averaged():
    errors = []
    for seed in range(20):
        points, observed = view(100, noise_px=0.5, seed=seed)
        result = register_image(points, observed, *near(), **SETTINGS)
        errors.append(angles_between(result.rotation[None], ROTATION[None])[0])
    assert 2e-5 < np.median(errors) < 4e-4


def test_a_rough_map_widens_the_threshold():
    """Young maps are off by more than the tracker: their images must not be lost."""
    points, observed = view(200)
    points = points * np.exp(0.4 * np.random.default_rng(0).standard_normal((200, 1)))
    result = register_image(points, observed, *near(), **SETTINGS)
    assert 3.0 < result.threshold <= 24.0
    assert result.inliers.mean() > 0.9
    assert_pose(result, angle_rad=0.02, distance=0.1)


def test_the_median_error_is_that_of_the_inliers():
    points, observed = view(100, noise_px=0.3)
    result = register_image(points, observed, *near(), **SETTINGS)
    q = points @ result.rotation.T + result.translation
    error = 600.0 * np.linalg.norm(q[:, :2] / q[:, 2:] - observed, axis=1)
    np.testing.assert_array_equal(result.inliers, error < result.threshold)
    assert result.error == pytest.approx(np.median(error[result.inliers]), rel=1e-9)


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_few_points_near_the_start(count):
    points, observed = view(count)
    result = register_image(points, observed, *near(), **SETTINGS)
    assert result.inliers.shape == (count,)
    assert result.inliers.all()
    assert result.error < 1e-12
    if count > 3:  # three points leave four solutions
        assert_pose(result, angle_rad=1e-14, distance=1e-14)


def test_nonsense_finds_few_inliers():
    points, observed = view(100)
    shuffled = np.random.default_rng(0).permutation(observed)
    assert register_image(points, shuffled, *near(), **SETTINGS).inliers.sum() < 8


def test_where_nothing_agrees_there_is_no_inlier():
    points, observed = view(4)
    result = register_image(points, observed + 1e4 * np.arange(1, 5)[:, None], *near(), **SETTINGS)
    assert not result.inliers.any()
    assert np.isfinite(result.covariance).all()


# --- the optimum ------------------------------------------------------------------------------------------------


def gtsam_optimum(points, observed, sigma):
    """Rotation and translation at the minimum of `image_reprojection_factor`, started at the truth, and its graph."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(image_reprojection_factor(X(0), points, observed, SETTINGS["focal"], sigma, _KERNEL))
    values.insert(X(0), pose_from_camera(ROTATION, TRANSLATION))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return *camera_from_pose(values.atPose3(X(0))), graph


def cost(graph, rotation, translation):
    values = gtsam.Values()
    values.insert(X(0), pose_from_camera(rotation, translation))
    return graph.error(values)


@pytest.mark.parametrize("outliers", [0, 20])
@pytest.mark.parametrize("noise_px", [0.0, 0.25])
@pytest.mark.parametrize("seed", range(3))
def test_alignment_finds_the_optimum_of_the_factor(noise_px, outliers, seed):
    points, observed = view(120, noise_px=noise_px, seed=seed)
    observed[:outliers] += np.random.default_rng(seed).normal(0, 0.03, (outliers, 2))
    rotation, translation = _align(points, observed, *near(), SETTINGS["focal"], 0.25)[:2]
    expected = gtsam_optimum(points, observed, 0.25)
    assert angles_between(rotation[None], expected[0][None])[0] < 1e-6
    assert np.linalg.norm(translation - expected[1]) < 1e-6 * 5  # the points are about five units away
    assert cost(expected[2], rotation, translation) == pytest.approx(
        cost(expected[2], *expected[:2]), rel=1e-6, abs=1e-9
    )


def test_alignment_under_more_noise_than_it_is_told_stays_far_below_the_noise():
    """The kernel makes convergence slow there; the rest is a few per cent of a standard deviation."""
    points, observed = view(120, noise_px=1.0)
    rotation, translation = _align(points, observed, *near(), SETTINGS["focal"], 0.25)[:2]
    expected = gtsam_optimum(points, observed, 0.25)
    assert angles_between(rotation[None], expected[0][None])[0] < 2e-5
    assert 4e-4 < angles_between(rotation[None], ROTATION[None])[0] < 1.5e-3
    assert cost(expected[2], rotation, translation) == pytest.approx(cost(expected[2], *expected[:2]), rel=1e-5)


def test_alignment_starts_with_points_behind_the_camera():
    points, observed = view(120)
    behind = rotation_matrices([0.0, 0.0, 0.3])[0] @ ROTATION, TRANSLATION - [0.0, 0.0, 3.0]
    q = points @ behind[0].T + behind[1]
    assert 0.05 < (q[:, 2] < 0).mean() < 0.5
    rotation, translation = _align(points, observed, *behind, SETTINGS["focal"], 25.0)[:2]
    assert angles_between(rotation[None], ROTATION[None])[0] < 1e-14
    assert np.linalg.norm(translation - TRANSLATION) < 1e-14


def test_the_covariance_is_that_of_the_errors():
    """In GTSAM's pose convention.

    The kernel's unit is the median length of the errors, 1.18 standard deviations: with Gaussian errors it then says
    1 / 0.61 times the variance that the poses have, on the safe side.
    """
    trials = []
    for seed in range(200):
        points, observed = view(120, noise_px=0.25, seed=seed)
        result = register_image(points, observed, *near(), **SETTINGS)
        truth = pose_from_camera(ROTATION, TRANSLATION)
        error = pose_from_camera(result.rotation, result.translation).localCoordinates(truth)
        trials.append(normalised(error, result.covariance))
    assert_calibrated(trials, 0.61, 0.61)


# --- scale and shift --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1.6, 0.4), (0.5, -0.1)])
def test_fit_affine_recovers_scale_and_shift(scale, shift):
    inverse = np.random.default_rng(0).uniform(0.3, 2, 200)
    fitted = fit_affine(inverse, scale * inverse + shift)
    assert fitted[0] == pytest.approx(scale, rel=1e-12)
    assert fitted[1] == pytest.approx(shift, abs=1e-12)
    assert fitted[2] <= 1e-6  # the least spread that it says


def test_fit_affine_with_noise_and_outliers():
    rng = np.random.default_rng(0)
    inverse = rng.uniform(0.3, 2, 400)
    measured = 1.3 * inverse + 0.2 + 0.05 * rng.standard_normal(400)
    measured[:80] = rng.uniform(0, 5, 80)
    scale, shift, spread = fit_affine(inverse, measured)
    assert scale == pytest.approx(1.3, abs=0.005)
    assert shift == pytest.approx(0.2, abs=0.005)
    assert 0.04 < spread < 0.08


def test_fit_affine_keeps_the_scale_positive():
    inverse = np.random.default_rng(0).uniform(0.3, 2, 200)
    scale, _, _ = fit_affine(inverse, 3 - inverse)
    assert 0.0 < scale < 0.2


def test_fit_affine_without_a_free_shift():
    inverse = np.random.default_rng(0).uniform(0.3, 2, 200)
    noisy = 1.5 * inverse + 0.1 * np.random.default_rng(1).standard_normal(200)
    scale, shift, _ = fit_affine(inverse, noisy, free_shift=False)
    assert scale == pytest.approx(1.5, rel=0.007)
    assert 1e-4 < abs(shift) < 0.005


def test_fit_affine_of_a_plane_parallel_to_the_image():
    """All points at one depth tell the scale or the shift, not both: the shift stays where its prior is."""
    measured = 2.0 + 0.01 * np.random.default_rng(0).standard_normal(50)
    scale, shift, _ = fit_affine(np.ones(50), measured)
    assert scale + shift == pytest.approx(2.0, abs=0.003)
    assert abs(shift) < 1e-4


# --- with depth -------------------------------------------------------------------------------------------------


def depths_of(points, *, scale=1.3, shift=0.2, noise=0.0):
    z = (points @ ROTATION.T + TRANSLATION)[:, 2]
    value = scale / z + shift + noise * np.random.default_rng(3).standard_normal(len(z))
    return ImageDepth(value, np.ones(len(z)), unit=1.0)


def test_inverse_domain_recovers_pose_and_affine():
    points, observed = view()
    result = register_image(points, observed, *near(), depth=depths_of(points), **SETTINGS)
    assert_pose(result, angle_rad=1e-14, distance=1e-14)
    assert result.affine == pytest.approx((1.3, 0.2), rel=1e-2)


def test_the_papers_domain_recovers_pose_and_affine():
    """min over R, t, gamma, beta of E_PR + lambda E_DC, where z = gamma D + beta."""
    points, observed = view()
    z = (points @ ROTATION.T + TRANSLATION)[:, 2]
    gamma, beta = 0.7, 0.3
    depth = ImageDepth(gamma / (z - beta), np.ones(len(z)), unit=1.0)
    result = register_image(points, observed, *near(), depth=depth, domain="depth", depth_weight=6.0, **SETTINGS)
    assert_pose(result, angle_rad=1e-14, distance=1e-14)
    assert result.affine == pytest.approx((gamma, beta), rel=1e-2)


@pytest.mark.parametrize("domain", ["inverse", "depth"])
def test_a_poor_prior_does_little_harm(domain):
    points, observed = view(100, noise_px=0.25)
    alone = register_image(points, observed, *near(), **SETTINGS)
    depth = depths_of(points, shift=0.0, noise=0.05)
    result = register_image(points, observed, *near(), depth=depth, domain=domain, depth_weight=6.0, **SETTINGS)
    assert result.affine is not None
    assert angles_between(result.rotation[None], alone.rotation[None])[0] < 1e-4
    assert np.linalg.norm(result.translation - alone.translation) < 4e-4
    assert result.inliers.mean() > 0.97


@pytest.mark.parametrize("broken", ["nan", "unreliable"])
def test_invalid_depth_takes_no_part(broken):
    points, observed = view()
    depth = depths_of(points)
    if broken == "nan":
        depth.inverse_depth[9:] = np.nan
    else:
        depth.reliability[9:] = 0.0
    assert register_image(points, observed, *near(), depth=depth, **SETTINGS).affine is None
    depth = depths_of(points)
    (depth.inverse_depth if broken == "nan" else depth.reliability)[20:] = np.nan if broken == "nan" else 0.0
    result = register_image(points, observed, *near(), depth=depth, **SETTINGS)
    assert result.affine == pytest.approx((1.3, 0.2), rel=2e-2)


def test_valid_depth():
    depth = ImageDepth(np.array([1.0, np.nan, 1.0, 0.0, np.inf]), np.array([1.0, 1.0, 0.2, 1.0, 1.0]), unit=2.0)
    np.testing.assert_array_equal(depth.valid, [True, False, False, False, False])


# --- on a shot --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["dolly", "truck", "handheld", "rotation", "arc"])
def test_every_frame_of_a_shot_from_the_one_before(motion):
    problem = make_problem(motion, frames=12)
    rotation, translation = np.eye(3), np.zeros(3)
    for frame in range(12):
        ids, xy = problem.of_frame(frame)
        result = register_image(
            problem.points[ids], xy, rotation, translation, focal=problem.focal, sigma=0.25, inlier_px=3.0
        )
        assert angles_between(result.rotation[None], problem.truth.rotation[frame][None])[0] < 1e-13
        assert np.linalg.norm(result.translation - problem.truth.translation[frame]) < 1e-13
        rotation, translation = result.rotation, result.translation


@pytest.mark.parametrize("seed", range(3))
def test_half_of_the_observations_may_be_wrong(seed):
    points, observed = view(200, noise_px=0.25, seed=seed)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(200)[:100]
    observed[wrong] = rng.uniform(-0.5, 0.5, (100, 2))
    result = register_image(points, observed, *near(), **SETTINGS)
    assert_pose(result, angle_rad=1e-3, distance=0.005)
    assert 95 <= result.inliers.sum() <= 110


@pytest.mark.parametrize("seed", range(3))
def test_something_that_moves_as_one_does_not_take_the_camera_along(seed):
    points, observed = view(200, noise_px=0.25, seed=seed)
    mover = np.random.default_rng(seed).permutation(200)[:60]
    observed[mover, 0] += 15.0 / SETTINGS["focal"]
    result = register_image(points, observed, *near(), **SETTINGS)
    assert_pose(result, angle_rad=3e-4, distance=0.0015)
    assert not result.inliers[mover].any()
