from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.prior_weight import PriorWeight, direction_angles, field_grid, measure_weight, sample_points

EXTENT = np.array([0.9, 0.5])  # of the directions, radians


def scene(count=100, seed=0):
    """Directions of points and their inverse depths, median about 1."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-EXTENT / 2, EXTENT / 2, (count, 2))
    return angles, rng.uniform(0.4, 1.6, count), rng


def smooth_field(angles, sigma, length, rng):
    """A draw from the model: exponential correlation over the direction."""
    distance = np.linalg.norm(angles[:, None] - angles[None], axis=2)
    covariance = np.exp(-distance / length) + 1e-9 * np.eye(len(angles))
    return sigma * np.linalg.cholesky(covariance) @ rng.standard_normal(len(angles))


def measured(smooth, local, *, length=0.3, geometry=0.01, seed=0):
    """Weight measured on data drawn from the model itself."""
    angles, inverse, rng = scene(seed=seed)
    prior = inverse + smooth_field(angles, smooth, length, rng) + local * rng.standard_normal(len(inverse))
    reconstructed = inverse + geometry * rng.standard_normal(len(inverse))
    return measure_weight(angles, reconstructed, prior, geometry**2 * np.eye(len(inverse)))


# --- directions and samples -------------------------------------------------------------------------------------


def test_direction_angles():
    tilt = 0.3
    bearing = np.array([[0, 0, 1], [np.sin(tilt), 0, np.cos(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    np.testing.assert_allclose(direction_angles(bearing), [[0, 0], [tilt, 0], [0, tilt]], atol=1e-12)


def test_sample_points_are_ascending_and_repeatable():
    sample = sample_points(1000)
    assert len(sample) == 200
    assert (np.diff(sample) > 0).all()
    assert sample[-1] < 1000
    np.testing.assert_array_equal(sample, sample_points(1000))
    np.testing.assert_array_equal(sample_points(5), np.arange(5))


# --- measuring --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("smooth", "local"), [(0.1, 0.1), (0.4, 0.07), (0.2, 0.3), (0.8, 0.2)])
def test_the_model_is_recovered_from_its_own_data(smooth, local):
    found = measured(smooth, local)
    assert 0.5 < found.smooth / smooth < 2.0
    assert 0.5 < found.local / local < 2.0
    assert 0.1 < found.length < 0.6


def test_a_good_prior_correlates():
    assert measured(0.05, 0.05).correlation > 0.9


def test_a_prior_that_says_nothing_is_found_out():
    angles, inverse, rng = scene()
    said = 1 + smooth_field(angles, 0.5, 0.3, rng)
    weight = measure_weight(angles, inverse, said, 1e-4 * np.eye(len(inverse)))
    assert abs(weight.correlation) < 0.35
    assert np.hypot(weight.smooth, weight.local) > 0.3


def test_a_mirrored_prior_has_a_negative_correlation():
    angles, inverse, _ = scene()
    assert measure_weight(angles, inverse, 2 - inverse, 1e-4 * np.eye(len(inverse))).correlation < -0.99


def test_uncertain_geometry_is_not_taken_for_an_error_of_the_prior():
    """Differences that the covariance of the geometry explains say nothing about the prior."""
    angles, inverse, rng = scene()
    reconstructed = inverse + 0.3 * rng.standard_normal(len(inverse))
    prior = inverse + 0.03 * rng.standard_normal(len(inverse))
    aware = measure_weight(angles, reconstructed, prior, 0.3**2 * np.eye(len(inverse)))
    unaware = measure_weight(angles, reconstructed, prior, 1e-4 * np.eye(len(inverse)))
    assert aware.local < 0.5 * unaware.local
    assert unaware.local == pytest.approx(0.3, rel=0.4)


def test_errors_that_scale_and_shift_absorb_do_not_count():
    angles, inverse, rng = scene()
    error = 0.1 * rng.standard_normal(len(inverse))
    plain = measure_weight(angles, inverse, inverse + error, 1e-4 * np.eye(len(inverse)))
    affine = measure_weight(angles, inverse, 1.2 * inverse - 0.2 + error, 1e-4 * np.eye(len(inverse)))
    assert affine == replace(plain, correlation=affine.correlation)


def test_outliers_do_not_decide():
    angles, inverse, rng = scene()
    prior = inverse + 0.1 * rng.standard_normal(len(inverse))
    prior[::20] += 5.0
    weight = measure_weight(angles, inverse, prior, 1e-4 * np.eye(len(inverse)))
    assert 0.05 < weight.local < 0.2
    assert 0.03 < weight.smooth < 0.16


# --- the field --------------------------------------------------------------------------------------------------


def test_the_nodes_interpolate_linear_functions_exactly():
    angles, _, _ = scene()
    nodes, weights, information, _ = field_grid(angles, PriorWeight(0.2, 0.05, 0.3, 0.9))
    count = len(information)
    assert nodes.min() >= 0
    assert nodes.max() < count
    assert (weights > -1e-12).all()
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-12)
    columns = nodes[0, 2] - nodes[0, 0]
    low, high = angles.min(0), angles.max(0)
    step = (high - low) / [columns - 1, count // columns - 1]
    place = low + np.stack([np.arange(count) % columns, np.arange(count) // columns], -1) * step
    np.testing.assert_allclose((weights[:, :, None] * place[nodes]).sum(1), angles, atol=1e-9)


def test_the_field_and_the_rest_have_the_variance_of_the_model():
    angles, _, _ = scene()
    weight = PriorWeight(0.2, 0.05, 0.3, 0.9)
    nodes, weights, information, rest = field_grid(angles, weight)
    covariance = np.linalg.inv(information)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.2, rtol=2e-6)
    assert (rest >= 0.05).all()
    assert (rest < np.hypot(0.05, 0.2)).all()
    # What the nodes do not carry is in the rest: nodes plus rest vary as the field and the local error together.
    mapping = np.zeros((len(angles), len(information)))
    np.put_along_axis(mapping, nodes, weights, 1)
    distance = np.linalg.norm(angles[:, None] - angles[None], axis=2)
    true = 0.2**2 * np.exp(-distance / weight.length)
    modelled = mapping @ covariance @ mapping.T + np.diag(rest**2 - 0.05**2)
    np.testing.assert_allclose(np.diag(modelled), np.diag(true), rtol=0.1)
    far = distance > 0.15
    np.testing.assert_allclose(modelled[far], true[far], atol=0.1 * 0.2**2)


def test_a_precise_prior_has_a_stiff_field():
    angles, _, _ = scene()
    stiff, loose = (field_grid(angles, PriorWeight(smooth, 0.05, 0.3, 0.9))[2] for smooth in (0.02, 0.5))
    np.testing.assert_allclose(stiff, loose * 25**2, rtol=2e-9)
