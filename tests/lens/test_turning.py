"""A camera that only turns: its focal length is found from any guess, whatever moves with it."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.lens.lens import through
from factorsfm.lens.turning import turning_camera
from factorsfm.support.options import PolishOptions
from tests.estimation_problems import angles_between, make_problem


def followed(problem, count):
    """The observations, with the first points at rest in the image: somebody whom the camera follows."""
    o = problem.observations
    places = o.pixels[o.first][o.point] + np.random.default_rng(3).normal(0.0, 1.0, o.pixels.shape)
    return replace(o, pixels=np.where((o.point < count)[:, None], places, o.pixels))


@pytest.mark.parametrize("guess", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_lens_of_a_pan_is_found(guess, share):
    problem = make_problem("rotation", frames=16, points=160, noise_px=0.1)
    seen = followed(problem, int(share * len(problem.points)))
    start = through(problem.truth, np.array([guess * problem.focal]))
    found = turning_camera(start, seen, PolishOptions())
    assert 1e-6 < abs(found.focal[0] / problem.focal - 1.0) < 0.01
    error_px = problem.focal * angles_between(found.rotation, problem.truth.rotation)
    assert 0.001 < error_px.max() < 2.0  # a focal length that is wrong by a percent turns by a percent less
    assert not found.translation.any()
