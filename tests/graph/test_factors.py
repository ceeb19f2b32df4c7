import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, L, T, X
from hypothesis import given, settings
from hypothesis import strategies as st

from factorsfm.adjustment.residuals import (
    affine_depth,
    affine_inverse_depth,
    by_pose,
    camera_points,
    cauchy,
    projection_by_pose,
    reprojection,
)
from factorsfm.graph.factors import (
    KERNEL,
    VIRTUAL_BASELINE,
    affine_of_native,
    affine_prior,
    camera_from_pose,
    constant_projection_factor,
    depth_consistency_factor,
    depth_noise,
    image_depth_factor,
    image_reprojection_factor,
    landmark_prior,
    native_affine,
    native_affine_noise,
    native_depth_factor,
    pixel_noise,
    pose_from_camera,
    pose_prior,
    projection_factor,
    virtual_offset,
)
from tests.estimation_problems import rotation_matrices

STEP = 1e-6
examples = settings(max_examples=25, deadline=None, derandomize=True)


def floats(low, high):
    return st.floats(low, high, allow_nan=False, width=64)


def vectors(reach):
    return st.tuples(*[floats(-reach, reach)] * 3).map(np.array)


@st.composite
def cameras(draw):
    """A camera that looks along z within some 45 degrees, near the origin."""
    return rotation_matrices(draw(vectors(0.4)))[0], draw(vectors(0.3))


@st.composite
def seen_points(draw, rotation, translation, count=7):
    """Points (count, 3) in front of a camera, 1 to 8 units away."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    z = rng.uniform(1, 8, count)
    q = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)) * z[:, None], z])
    return (q - translation) @ rotation, rng


@st.composite
def images(draw):
    rotation, translation = draw(cameras())
    return rotation, translation, *draw(seen_points(rotation, translation))


def central_difference(function, size):
    """Jacobian (..., size) of a function of a small step at zero."""
    columns = [(function(step) - function(-step)) / (2 * STEP) for step in STEP * np.eye(size)]
    return np.stack(columns, -1)


def assert_derivative(analytic, function, size):
    numerical = central_difference(function, size)
    assert analytic.shape == numerical.shape
    np.testing.assert_allclose(analytic, numerical, rtol=2e-6, atol=1e-6 * max(1.0, np.abs(numerical).max()))


def dimension(values, key):
    return values.zeroVectors().at(key).size


def moved(values, key, step):
    """Values with one variable moved by a tangent step."""
    delta = values.zeroVectors()
    one = gtsam.VectorValues()
    one.insert(key, step)
    delta.update(one)
    return values.retract(delta)


def jacobians(factor, values):
    """Jacobian of every key of a factor as GTSAM sees it, in the order of its keys."""
    matrix, _ = factor.linearize(values).jacobian()
    keys = factor.keys()
    widths = [dimension(values, key) for key in keys]
    return np.split(matrix, np.cumsum(widths)[:-1], axis=1)


def assert_gtsam_derivatives(factor, values):
    """Every Jacobian block of a factor against central differences of its whitened error."""
    for key, block in zip(factor.keys(), jacobians(factor, values), strict=True):
        assert_derivative(block, lambda step, k=key: factor.whitenedError(moved(values, k, step)), block.shape[1])


# --- definitions ------------------------------------------------------------------------------------------------


def test_camera_points_are_homogeneous():
    rotation, translation = rotation_matrices([0.1, -0.2, 0.3])[0], np.array([0.5, -1.0, 2.0])
    euclidean = np.array([[1.0, 2.0, 5.0], [-1.0, 0.5, 3.0]])
    distance = np.linalg.norm(euclidean, axis=1)
    q = camera_points(rotation, translation, euclidean / distance[:, None], 1 / distance)
    np.testing.assert_allclose(q * distance[:, None], euclidean @ rotation.T + translation, atol=1e-12)


@examples
@given(images(), floats(200, 2000))
def test_reprojection_derivative(image, focal):
    rotation, translation, points, rng = image
    q = camera_points(rotation, translation, points, np.ones(len(points)))
    observed = rng.uniform(-300, 300, (len(q), 2))
    residual, by_q = reprojection(q, observed, focal)
    np.testing.assert_allclose(residual, focal * q[:, :2] / q[:, 2:] - observed, atol=1e-9)
    assert_derivative(by_q, lambda d: reprojection(q + d, observed, focal)[0], 3)


@examples
@given(images(), floats(0.1, 5), floats(-1, 1))
def test_affine_inverse_depth_derivatives(image, scale, shift):
    rotation, translation, points, rng = image
    w = rng.uniform(0.1, 2, len(points))
    q = camera_points(rotation, translation, points, np.ones(len(points)))
    measured = rng.uniform(0, 2, len(points))
    residual, by_z, by_w = affine_inverse_depth(q, w, scale, shift, measured)
    np.testing.assert_allclose(residual, scale * w / q[:, 2] + shift - measured, atol=1e-12)
    along = np.array([0.0, 0.0, 1.0])
    assert_derivative(by_z[:, None], lambda d: affine_inverse_depth(q + d * along, w, scale, shift, measured)[0], 1)
    assert_derivative(by_w[:, None], lambda d: affine_inverse_depth(q, w + d, scale, shift, measured)[0], 1)
    affine = np.stack([w / q[:, 2], np.ones(len(q))], -1)
    assert_derivative(affine, lambda d: affine_inverse_depth(q, w, scale + d[0], shift + d[1], measured)[0], 2)


@examples
@given(images(), floats(0.1, 5), floats(-1, 1))
def test_affine_depth_derivatives(image, gamma, beta):
    rotation, translation, points, rng = image
    q = camera_points(rotation, translation, points, np.ones(len(points)))
    depth = rng.uniform(0.5, 8, len(points))
    residual, by_z = affine_depth(q, gamma, beta, depth)
    np.testing.assert_allclose(residual, q[:, 2] - gamma * depth - beta, atol=1e-12)
    along = np.array([0.0, 0.0, 1.0])
    assert_derivative(by_z[:, None], lambda d: affine_depth(q + d * along, gamma, beta, depth)[0], 1)
    affine = np.stack([-depth, -np.ones(len(q))], -1)
    assert_derivative(affine, lambda d: affine_depth(q, gamma + d[0], beta + d[1], depth)[0], 2)


@examples
@given(images())
def test_by_pose_is_the_derivative_by_gtsams_pose(image):
    rotation, translation, points, rng = image
    w = rng.uniform(0.1, 2, len(points))
    pose = pose_from_camera(rotation, translation)

    def after(step):
        return camera_points(*camera_from_pose(pose.retract(step)), points, w)

    q = after(np.zeros(6))
    np.testing.assert_allclose(q, camera_points(rotation, translation, points, w), atol=1e-12)
    analytic = np.stack([by_pose(np.broadcast_to(axis, q.shape), q, w) for axis in np.eye(3)], 1)
    assert_derivative(analytic, after, 6)


@examples
@given(images(), floats(200, 2000))
def test_projection_by_pose_is_reprojection_chained_by_pose(image, focal):
    rotation, translation, points, _ = image
    one = np.ones(len(points))
    q = camera_points(rotation, translation, points, one)
    prediction, derivative = projection_by_pose(q.T, focal)
    expected, by_q = reprojection(q, np.zeros((len(q), 2)), focal)
    np.testing.assert_allclose(prediction.T, expected, rtol=1e-12)
    chained = by_pose(by_q.transpose(1, 0, 2), q, one)
    np.testing.assert_allclose(derivative, chained.transpose(2, 0, 1), rtol=1e-9, atol=1e-9 * focal)


def test_poses_and_cameras_are_inverse():
    rotation, translation = rotation_matrices([0.3, -0.5, 1.2])[0], np.array([0.5, -1.0, 2.0])
    pose = pose_from_camera(rotation, translation)
    np.testing.assert_allclose(pose.transformTo(np.array([1.0, 2.0, 3.0])), rotation @ [1, 2, 3] + translation)
    back = camera_from_pose(pose)
    np.testing.assert_allclose(back[0], rotation, atol=1e-12)
    np.testing.assert_allclose(back[1], translation, atol=1e-12)


@pytest.mark.parametrize("width", [1, 2])
def test_cauchy_is_gtsams(width):
    rng = np.random.default_rng(width)
    residual = rng.standard_normal((50, width)) * rng.choice([1e-8, 0.1, 1, 30], (50, 1))
    cost, weight = cauchy(residual, 1.7)
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(1.7)
    norm = np.linalg.norm(residual, axis=1)
    np.testing.assert_allclose(cost, [kernel.loss(n) for n in norm], rtol=1e-12)
    np.testing.assert_allclose(weight, [kernel.weight(n) for n in norm], rtol=1e-12)


# --- whole images -----------------------------------------------------------------------------------------------


def assert_robust_gradient(factor, values, cost):
    """Half the squared norm is the robust cost, and the linearised gradient is that of the cost."""
    assert factor.error(values) == pytest.approx(cost, rel=1e-12)
    matrix, right = factor.linearize(values).jacobian()
    keys = factor.keys()
    numerical = [
        central_difference(lambda step, k=key: np.array(factor.error(moved(values, k, step))), dimension(values, key))
        for key in keys
    ]
    numerical = np.concatenate(numerical)
    # The narrowest kernel bends within a step.
    np.testing.assert_allclose(-matrix.T @ right, numerical, rtol=1e-5, atol=1e-5 * np.abs(numerical).max())


@examples
@given(images(), floats(0.5, 5))
def test_image_reprojection_factor(image, kernel):
    rotation, translation, points, rng = image
    focal, sigma = 600.0, 0.5
    q = points @ rotation.T + translation
    errors_px = rng.standard_normal((len(q), 2)) * rng.choice([0.3, 20.0], (len(q), 1))  # some are outliers
    observed = q[:, :2] / q[:, 2:] + errors_px / focal
    values = gtsam.Values()
    values.insert(X(0), pose_from_camera(rotation, translation))
    factor = image_reprojection_factor(X(0), points, observed, focal, sigma, kernel)
    assert_robust_gradient(factor, values, cauchy(errors_px / sigma, kernel)[0].sum())
    unlimited = image_reprojection_factor(X(0), points, observed, focal, sigma, 1e6)
    np.testing.assert_allclose(unlimited.whitenedError(values), -(errors_px / sigma).ravel(), atol=1e-7)
    assert_gtsam_derivatives(unlimited, values)


@pytest.mark.parametrize("domain", ["inverse", "depth"])
@examples
@given(images(), floats(0.2, 3), floats(-0.3, 0.3), floats(0.5, 5))
def test_image_depth_factor(domain, image, scale, shift, kernel):
    rotation, translation, points, rng = image
    z = (points @ rotation.T + translation)[:, 2]
    sigma = rng.uniform(0.02, 0.1, len(z))
    error = sigma * rng.standard_normal(len(z)) * rng.choice([0.5, 20], len(z))
    measured = scale / z + shift - error if domain == "inverse" else (z - shift - error) / scale
    values = gtsam.Values()
    values.insert(X(0), pose_from_camera(rotation, translation))
    values.insert(A(0), np.array([scale, shift]))
    factor = image_depth_factor(X(0), A(0), points, measured, sigma, kernel, domain=domain)
    assert_robust_gradient(factor, values, cauchy((error / sigma)[:, None], kernel)[0].sum())
    unlimited = image_depth_factor(X(0), A(0), points, measured, sigma, 1e6, domain=domain)
    np.testing.assert_allclose(unlimited.whitenedError(values), error / sigma, atol=1e-7)
    assert_gtsam_derivatives(unlimited, values)


def test_a_residual_of_zero_has_a_jacobian():
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.5, 4.0], [-1.0, 0.3, 3.0]])
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    factor = image_reprojection_factor(X(0), points, points[:, :2] / points[:, 2:], 500.0, 1.0, 2.0)
    assert factor.error(values) == pytest.approx(0.0, abs=1e-18)
    assert_gtsam_derivatives(factor, values)
    matrix, _ = factor.linearize(values).jacobian()
    assert np.linalg.matrix_rank(matrix) == 6


# --- one observation --------------------------------------------------------------------------------------------


@st.composite
def depth_observations(draw):
    rotation, translation, points, rng = draw(images())
    return rotation, translation, points[0], draw(floats(0.2, 3)), draw(floats(-0.3, 0.3)), rng.uniform(0, 2)


def readable_and_native(observation):
    """Both forms of one residual with unit noise, and values that hold the same state for each."""
    rotation, translation, point, scale, shift, measured = observation
    readable, native = gtsam.Values(), gtsam.Values()
    for values in (readable, native):
        values.insert(X(0), pose_from_camera(rotation, translation))
        values.insert(L(0), point)
    readable.insert(A(0), np.array([scale, shift]))
    native.insert(A(0), native_affine(scale, shift))
    native.insert(T(0), virtual_offset())
    noise = gtsam.noiseModel.Unit.Create(1)
    return (
        (depth_consistency_factor(X(0), L(0), A(0), measured, noise), readable),
        (native_depth_factor(X(0), T(0), L(0), A(0), measured, gtsam.noiseModel.Unit.Create(2)), native),
    )


@examples
@given(depth_observations())
def test_depth_consistency_factor(observation):
    rotation, translation, point, scale, shift, measured = observation
    factor, values = readable_and_native(observation)[0]
    z = (rotation @ point + translation)[2]
    np.testing.assert_allclose(factor.whitenedError(values), [scale / z + shift - measured], atol=1e-12)
    assert_gtsam_derivatives(factor, values)


@examples
@given(depth_observations())
def test_native_depth_factor_equals_the_readable_form(observation):
    rotation, translation, point, scale, *_ = observation
    (factor, values), (native_factor, native_values) = readable_and_native(observation)
    q = rotation @ point + translation
    # The model error of the residual is a x / (z B); that of its derivatives is of the same order.
    residual = native_factor.whitenedError(native_values)[0] - factor.whitenedError(values)[0]
    assert residual == pytest.approx(scale * q[0] / q[2] / VIRTUAL_BASELINE, rel=1e-5, abs=1e-9)
    limit = 5 * (1 + abs(scale)) * (1 + np.abs(q).max()) / VIRTUAL_BASELINE
    pose, point_block, affine = jacobians(factor, values)
    native_pose, _, native_point, native_calibration = (b[:1] for b in jacobians(native_factor, native_values))
    np.testing.assert_allclose(native_pose, pose, atol=limit)
    np.testing.assert_allclose(native_point, point_block, atol=limit)
    np.testing.assert_allclose(native_calibration[:, 0] / VIRTUAL_BASELINE, affine[:, 0], atol=limit)  # scale
    np.testing.assert_allclose(native_calibration[:, 3], affine[:, 1], atol=1e-12)  # shift


def test_native_depth_factor_derivatives():
    camera = rotation_matrices([0.1, -0.2, 0.05])[0], np.array([0.1, -0.1, 0.2])
    factor, values = readable_and_native((*camera, np.array([0.5, -0.7, 3.0]), 1.3, 0.1, 0.4))[1]
    pose, _, point, calibration = (block[:1] for block in jacobians(factor, values))
    for key, block in [(X(0), pose), (L(0), point)]:
        assert_derivative(block, lambda d, k=key: factor.whitenedError(moved(values, k, d))[:1], block.shape[1])
    to_calibration = np.zeros((5, 2))  # of scale and shift in fx, fy, skew, u0, v0
    to_calibration[0, 0], to_calibration[3, 1] = 1 / VIRTUAL_BASELINE, 1
    assert_derivative(
        calibration @ to_calibration, lambda d: factor.whitenedError(moved(values, A(0), to_calibration @ d))[:1], 2
    )


@given(floats(1e-3, 1e3), floats(-10, 10))
def test_native_affine_round_trip(scale, shift):
    assert affine_of_native(native_affine(scale, shift)) == pytest.approx((scale, shift), rel=1e-12, abs=1e-12)


def test_native_affine_noise_weighs_scale_and_shift():
    prior = gtsam.PriorFactorCal3_S2(A(0), native_affine(1.0, 0.0), native_affine_noise(0.5, 0.3))
    for scale, shift in [(1.5, 0.0), (1.0, -0.3)]:
        values = gtsam.Values()
        values.insert(A(0), native_affine(scale, shift))
        assert prior.error(values) == pytest.approx(0.5, rel=1e-9)  # one standard deviation away


# --- the keyframe graph -----------------------------------------------------------------------------------------


@examples
@given(images(), floats(200, 2000))
def test_projection_factors_of_free_and_constant_cameras(image, focal):
    rotation, translation, points, rng = image
    point, pixels, one = points[0], rng.uniform(-300, 300, 2), np.ones(1)
    lens, pose, noise = gtsam.Cal3_S2(focal, focal, 0, 0, 0), pose_from_camera(rotation, translation), unit_noise(2)
    values = gtsam.Values()
    values.insert(X(0), pose)
    values.insert(L(0), point)
    free = projection_factor(pixels, noise, X(0), L(0), lens)
    constant = constant_projection_factor(gtsam.PinholePoseCal3_S2(pose, lens), pixels, noise, L(0))
    q = camera_points(rotation, translation, point[None], one)
    expected, _ = reprojection(q, pixels[None], focal)
    for factor in (free, constant):
        np.testing.assert_allclose(factor.whitenedError(values), expected[0], atol=1e-8)
        assert_gtsam_derivatives(factor, values)
    np.testing.assert_allclose(jacobians(constant, values)[0], jacobians(free, values)[1], rtol=1e-9, atol=1e-9 * focal)


def unit_noise(rows):
    return gtsam.noiseModel.Unit.Create(rows)


@pytest.mark.parametrize("error", [0.1, 1.0, 30.0])
def test_observations_have_the_cauchy_cost_of_their_noise(error):
    sigma, focal = 0.4, 500.0
    lens = gtsam.Cal3_S2(focal, focal, 0, 0, 0)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(L(0), np.array([0.2, -0.1, 2.0]))
    pixels = focal * np.array([0.1, -0.05]) + error * np.array([0.6, 0.8])
    expected = cauchy(np.array([[error / sigma]]), KERNEL)[0].item()
    camera = gtsam.PinholePoseCal3_S2(gtsam.Pose3(), lens)
    assert projection_factor(pixels, pixel_noise(sigma), X(0), L(0), lens).error(values) == pytest.approx(expected)
    constant = constant_projection_factor(camera, pixels, pixel_noise(sigma), L(0))
    assert constant.error(values) == pytest.approx(expected)


@pytest.mark.parametrize("error", [0.01, 0.1, 3.0])
def test_depths_have_the_cauchy_cost_of_their_noise(error):
    sigma, values = 0.05, gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(T(0), virtual_offset())
    values.insert(L(0), np.array([0.0, 0.3, 2.0]))
    values.insert(A(0), native_affine(1.2, 0.1))
    factor = native_depth_factor(X(0), T(0), L(0), A(0), 1.2 / 2.0 + 0.1 - error, depth_noise(sigma))
    expected = cauchy(np.array([[error / sigma]]), KERNEL)[0].item()
    assert factor.error(values) == pytest.approx(expected, rel=1e-6)  # the second row means nothing


def test_priors_are_zero_at_their_value_and_one_half_a_deviation_away():
    pose, point = pose_from_camera(*rotation_matrices([0.1, -0.2, 0.3]), np.array([0.5, -1.0, 2.0])), np.ones(3)
    affine = native_affine(1.5, 0.2)
    for factor, key, value, step in (
        (pose_prior(X(0), pose, 0.3), X(0), pose, 0.3 * np.eye(6)),
        (landmark_prior(L(0), point, 0.7), L(0), point, 0.7 * np.eye(3)),
        (
            affine_prior(A(0), 1.5, 0.2, 0.5, 0.3),
            A(0),
            affine,
            np.array([[0.5 / VIRTUAL_BASELINE, 0, 0, 0, 0], [0, 0, 0, 0.3, 0]]),
        ),
    ):
        values = gtsam.Values()
        values.insert(key, value)
        assert factor.error(values) == pytest.approx(0.0, abs=1e-18)
        for one in step:
            assert factor.error(moved(values, key, one)) == pytest.approx(0.5, rel=1e-9)
        assert_gtsam_derivatives(factor, values)
