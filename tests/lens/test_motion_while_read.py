"""How tracks move while an image is read out, from the images around it: without the error of the image itself."""

import numpy as np
import pytest

from factorsfm.lens.rolling_shutter import _motion

VELOCITY = np.array([0.02, -0.01])


@pytest.mark.parametrize(
    "missing", [(), (0, 1), (2, 3), (0,), (3,)], ids=["middle", "first", "last", "second", "last but one"]
)
def test_an_error_of_the_image_itself_takes_no_part(missing):
    place = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2))
    own = 0.005 * np.random.default_rng(1).normal(size=(40, 2))
    velocity = np.tile(VELOCITY, (4, 40, 1))
    velocity[1] += own
    velocity[2] -= own
    velocity[list(missing)] = np.nan
    motion, acceleration = _motion(velocity, np.ones(4), place)
    if missing in ((0, 1), (2, 3)):  # no acceleration is known
        np.testing.assert_allclose(acceleration, 0.0, atol=1e-12)
    np.testing.assert_allclose(motion, np.tile(VELOCITY, (40, 1)), atol=1e-12)


def test_a_track_of_two_images_has_the_motion_between_them():
    velocity = np.full((4, 1, 2), np.nan)
    velocity[2] = VELOCITY
    motion, _ = _motion(velocity, np.ones(4), np.zeros((1, 2)))
    np.testing.assert_allclose(motion, [VELOCITY])
