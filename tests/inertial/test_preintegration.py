from dataclasses import replace

import numpy as np
import pytest

from factorsfm.inertial.preintegration import inertial_steps, preintegrate
from factorsfm.inertial.recording import ImuNoise
from factorsfm.support.errors import InputError
from factorsfm.support.rotations import logarithm
from factorsfm.synthetic.imu import handheld_path, simulate_imu

PATH = handheld_path(4.0, 1)
GRAVITY = np.array([1.0, 9.7, -0.8])
BIASES = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.2, -0.05])
STARTS, ENDS = np.array([0.103, 1.0, 2.0]), np.array([0.4, 1.3, 3.1717])  # on samples and between them


def recording(**options):
    return simulate_imu(PATH, gravity=GRAVITY, gyroscope_bias=BIASES[0], accelerometer_bias=BIASES[1], **options)


def true_motion():
    """Rotation, velocity and position of the intervals as preintegration defines them."""
    i, j, t = PATH.motion(STARTS), PATH.motion(ENDS), (ENDS - STARTS)[:, None]
    back = i.world_from_cam.swapaxes(1, 2)
    velocity = np.einsum("nij,nj->ni", back, j.velocity - i.velocity - GRAVITY * t)
    position = np.einsum("nij,nj->ni", back, j.center - i.center - i.velocity * t - GRAVITY * t**2 / 2)
    return back @ j.world_from_cam, velocity, position


def difference(motion, rotation, velocity, position):
    """(m, 9) rotation vector, velocity and position of a preintegration less others."""
    turn = logarithm(rotation.swapaxes(1, 2) @ motion.rotation)
    return np.hstack([turn, motion.velocity - velocity, motion.position - position])


def test_preintegration_is_the_motion_without_gravity():
    """Its error falls with the square of the rate."""
    errors = [
        abs(difference(preintegrate(recording(rate=rate), STARTS, ENDS, *BIASES), *true_motion())).max(axis=0)
        for rate in (200.0, 800.0)
    ]
    assert (errors[0] < np.repeat([1e-5, 1e-4, 1e-4], 3)).all()
    assert (errors[1] < 0.2 * errors[0]).all()


def test_derivatives_by_the_biases():
    exact, step = recording(), 1e-5
    by_bias = preintegrate(exact, STARTS, ENDS, *BIASES).by_bias
    for k, change in enumerate(step * np.eye(6)):
        high, low = (
            preintegrate(exact, STARTS, ENDS, BIASES[0] + s * change[:3], BIASES[1] + s * change[3:]) for s in (1, -1)
        )
        slope = difference(high, low.rotation, low.velocity, low.position) / (2 * step)
        np.testing.assert_allclose(by_bias[:, :, k], slope, atol=2e-8)


def test_the_covariance_is_that_of_a_hundred_draws():
    noise = replace(ImuNoise(), gyroscope_walk=1e-9, accelerometer_walk=1e-9)
    draws = [
        difference(preintegrate(recording(noise=noise, seed=seed), STARTS, ENDS, *BIASES), *true_motion())
        for seed in range(100)
    ]
    covariance = preintegrate(recording(noise=noise), STARTS, ENDS, *BIASES).covariance
    for errors, expected in zip(np.moveaxis(draws, 1, 0), covariance, strict=True):
        normed = np.mean(np.einsum("sr,rc,sc->s", errors, np.linalg.inv(expected), errors)) / 9
        assert 0.88 < normed < 1.12


def test_steps_end_where_the_interval_ends():
    durations, turns, _ = inertial_steps(recording(), STARTS, ENDS)
    np.testing.assert_allclose(durations.sum(axis=1), ENDS - STARTS, atol=1e-12)
    assert durations.min() >= 0
    assert turns.shape == (*durations.shape, 3)


@pytest.mark.parametrize(
    ("starts", "ends", "message"),
    [
        ([0.5], [0.5], "ends before it starts"),
        ([-0.5], [0.5], "covers 0.000 to 4.000 s; -0.500 to 0.500 s are asked for"),
        ([3.5], [4.5], "covers 0.000 to 4.000 s; 3.500 to 4.500 s are asked for"),
    ],
)
def test_an_interval_outside_the_recording_is_refused(starts, ends, message):
    with pytest.raises(InputError, match=message):
        preintegrate(recording(), np.array(starts), np.array(ends), *BIASES)
