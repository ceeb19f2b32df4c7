import numpy as np

from factorsfm.support.rotations import exponential, logarithm, right_jacobian


def vectors():
    """Rotation vectors of every length up to almost half a turn."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.concatenate([np.logspace(-12, 0, 200), rng.uniform(0, np.pi, 200)])[:, None]


def test_the_logarithm_inverts_the_exponential():
    np.testing.assert_allclose(logarithm(exponential(vectors())), vectors(), rtol=1e-9, atol=1e-14)


def test_the_logarithm_of_half_a_turn_is_its_axis():
    for axis in np.eye(3):
        np.testing.assert_allclose(abs(logarithm(exponential(np.pi * axis[None]))[0]), np.pi * axis, atol=1e-9)


def test_the_right_jacobian_is_the_derivative_of_the_exponential():
    v, step = vectors(), 1e-6
    for axis in np.eye(3):
        turned = logarithm(exponential(v - step * axis).swapaxes(1, 2) @ exponential(v + step * axis)) / (2 * step)
        np.testing.assert_allclose(turned, right_jacobian(v) @ axis, atol=1e-8)
