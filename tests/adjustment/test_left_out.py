"""Steps without some of the observations: those that a problem without them takes."""

from dataclasses import replace

import numpy as np

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.problem import ErrorModel, Free, Known, LensPrior
from factorsfm.support.options import PolishOptions
from tests.estimation_problems import make_problem


def test_a_step_without_a_part_is_that_of_the_rest_alone():
    problem = make_problem("arc", frames=12, points=60, parallax=0.2, noise_px=0.3)
    rng, o = np.random.default_rng(0), problem.observations
    part = rng.integers(0, 4, len(o.frame))
    part[o.point < 3] = 1  # points of which nothing is left
    part[o.frame == 5] = 2  # and a frame
    last = o.first[10:14]
    part[np.isin(o.point, np.arange(10, 14))] = 3
    part[last] = 0  # points of which one observation is left
    prior = Known(lens=LensPrior(problem.truth.lens, np.array([0.1, 0.1, 0.0, 0.0, 0.0, 0.0])))
    free, options = Free(focal=True), PolishOptions()
    steps = BundleAdjustment(
        problem.truth, o, options, ErrorModel(0.3), free=free, known=prior
    ).lens_steps_without(part)  # fmt: skip
    assert steps.shape == (4, 3)
    for left_out in range(4):
        rest = part != left_out
        rest &= np.bincount(o.point, rest)[o.point] >= 2
        points, point = np.unique(o.point[rest], return_inverse=True)
        state = problem.truth.of(points)
        # Few points would have another typical distance, of which the prior is made.
        scale = np.median(state.inverse_distance) / np.median(problem.truth.inverse_distance)
        alone = BundleAdjustment(
            state, o.at(rest, point=point), replace(options, point_sigma=options.point_sigma / scale),
            ErrorModel(0.3), free=free, known=prior,
        )  # fmt: skip
        np.testing.assert_allclose(steps[left_out], alone.lens_step(), rtol=1e-6, atol=1e-10)
    assert np.abs(steps).max() > 1e-5
