"""Cameras that are stuck away from the path of the others."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.motion.readings import solution_from
from factorsfm.polish.stuck_frames import freed
from factorsfm.support.options import Options
from tests.estimation_problems import make_problem, perturbed

TIMES = np.array([0, 1, 2, 3, 4, 6, 8, 9, 10, 11, 12, 13])  # some frames of the shot are not among them


def centers(state):
    return -np.einsum("kji,kj->ki", state.rotation, state.translation)


@pytest.fixture(scope="module")
def right():
    """A truck, solved."""
    problem = make_problem("truck", frames=len(TIMES), points=150, parallax=0.1, noise_px=0.1)
    return solution_from(perturbed(problem.truth, structure=0.05), problem.observations, Options().polish)


def moved(solved, row, shift):
    translation = solved.state.translation.copy()
    translation[row] += shift
    return replace(solved.state, translation=translation)


@pytest.mark.parametrize("stuck", [1, 5, 11])
def test_a_camera_that_is_stuck_returns_to_the_others(right, stuck):
    wrong = moved(right, stuck, [0.3, 0.2, 0.1])
    found = freed(BundleAdjustment(wrong, right.observations, right.options, right.errors), TIMES, Options())
    assert np.linalg.norm(centers(found.state) - centers(right.state), axis=1).max() < 2e-3
    assert np.median(found.reprojection_errors()) < 1.05 * np.median(right.reprojection_errors())


def test_a_solution_on_its_path_stays_as_it_is(right):
    assert freed(right, TIMES, Options()) is right


def test_a_camera_that_was_jolted_stays_where_the_images_show_it(right):
    jolted, o = moved(right, 5, [0.0, 0.05, 0.0]), right.observations
    q = jolted.camera_points(o.frame, o.point)
    seen = replace(o, pixels=jolted.focal[o.frame, None] * q[:, :2] / q[:, 2:])
    solved = BundleAdjustment(jolted, seen, right.options, right.errors)
    assert freed(solved, TIMES, Options()) is solved


def test_few_frames_tell_no_path(right):
    few = right.state.in_frames(np.arange(4))
    rows = right.observations.frame < 4
    wrong = replace(few, translation=few.translation + [[0, 0, 0], [0, 0.1, 0], [0, 0, 0], [0, 0, 0]])
    solved = BundleAdjustment(wrong, right.observations.at(rows), right.options, right.errors)
    assert freed(solved, TIMES[:4], Options()) is solved
