"""Near and far exchanged: the prior decides where the images hardly tell, and is contradicted where they do."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.motion.readings import reversed_scene, solution_from
from factorsfm.polish.near_and_far import near_and_far
from factorsfm.support.options import Options, PolishOptions
from tests.estimation_problems import make_problem, mapped_images


def sideways(parallax):
    return make_problem("truck", frames=12, points=200, parallax=parallax, noise_px=0.1)


def beside_the_prior(problem, start):
    images = [image.tracks for image in mapped_images(problem, problem.truth, guided=range(12), noise=0.02)]
    solved = solution_from(start, problem.observations, PolishOptions())
    return near_and_far(solved, np.arange(len(problem.points)), images, solved.error_inflation(), Options())


@pytest.mark.parametrize("parallax", [0.003, 0.05])
def test_a_reversed_scene_is_turned_round(parallax):
    problem = sideways(parallax)
    found = beside_the_prior(problem, reversed_scene(problem.truth))
    correlation = np.corrcoef(found.adjustment.state.inverse_distance, problem.truth.inverse_distance)[0, 1]
    assert correlation > 0.3
    assert found.prior is not None
    assert found.prior.weight.correlation > 0.5
    assert found.correlation is None


def test_a_prior_that_the_images_refute_is_told_of():
    problem = sideways(0.1)
    depth = problem.points[:, 2]
    exchanged = replace(problem, points=np.column_stack([problem.points[:, :2], 2.2 * np.median(depth) - depth]))
    images = [image.tracks for image in mapped_images(exchanged, problem.truth, guided=range(12), noise=0.02)]
    solved = BundleAdjustment(problem.truth, problem.observations, Options().polish, ErrorModel(0.1))
    solved.solve()
    found = near_and_far(solved, np.arange(len(problem.points)), images, 1.0, Options())
    assert found.adjustment is solved
    assert found.prior is None
    assert -0.6 < found.correlation < -0.2
