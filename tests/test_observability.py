from dataclasses import replace

import numpy as np
import pytest
from estimation_problems import angles_between, make_problem, perturbed

from factorsfm.observability import classify_motion, displacement
from factorsfm.options import PolishOptions
from factorsfm.problem import Observations
from factorsfm.reconstruction import ShotKind
from factorsfm.refinement import BundleAdjustment

OPTIONS = PolishOptions()


def classified(problem):
    """The motion of a shot, after cameras and points have converged with the noise that the shot has."""
    start = perturbed(problem.truth, angle_rad=1e-3, shift=1e-3)
    adjustment = BundleAdjustment(start, problem.observations, OPTIONS, sigma=problem.noise_px)
    adjustment.solve()
    return classify_motion(adjustment, problem.observations, OPTIONS)


def shot(motion, *, noise_px=0.1, seed=0, **kwargs):
    return make_problem(motion, **({"frames": 15, "points": 120} | kwargs), noise_px=noise_px, seed=seed)


# --- displacement -----------------------------------------------------------------------------------------------


def test_displacement_is_the_largest_median_over_the_frames():
    frame = np.tile([0, 1, 2], 3)
    point = np.repeat([0, 1, 2], 3)
    xy = np.zeros((9, 2))
    xy[frame == 1, 0] = [0.01, 0.02, 0.09]
    xy[frame == 2, 1] = [0.01, 0.015, 0.02]
    assert displacement(Observations(frame, point, xy)) == pytest.approx(0.02)


def test_displacement_counts_from_the_first_appearance():
    frame, point = np.array([0, 1, 1, 2]), np.array([0, 0, 1, 1])
    xy = np.array([[0.0, 0], [0.1, 0], [5.0, 5], [5.0, 5.1]])
    assert displacement(Observations(frame, point, xy)) == pytest.approx(0.1)


def test_displacement_of_a_rotation():
    problem = make_problem("rotation")
    moved = displacement(problem.observations)
    assert moved == pytest.approx(np.radians(12), rel=0.1)


# --- kinds ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_a_tripod_shot_is_static(noise_px):
    motion = classified(shot("static", noise_px=noise_px))
    assert motion.kind is ShotKind.STATIC
    assert motion.displacement_px < 5 * noise_px


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_a_pan_on_a_tripod_is_a_rotation(noise_px):
    problem = shot("rotation", noise_px=noise_px)
    motion = classified(problem)
    assert motion.kind is ShotKind.ROTATION
    assert motion.displacement_px == pytest.approx(problem.focal * np.radians(12), rel=0.15)
    assert angles_between(motion.rotation_only.rotation, problem.truth.rotation).max() < 2e-3 * noise_px / 0.3
    assert not motion.rotation_only.translation.any()


@pytest.mark.parametrize("parallax", [0.01, 0.05])
@pytest.mark.parametrize("name", ["dolly", "truck", "handheld", "arc"])
def test_translation_is_general_motion(name, parallax):
    motion = classified(shot(name, parallax=parallax))
    assert motion.kind is ShotKind.GENERAL
    assert motion.gain > 1.0


@pytest.mark.parametrize("name", ["truck", "handheld"])
def test_a_small_but_real_translation_is_general_motion(name):
    assert classified(shot(name, parallax=0.003)).kind is ShotKind.GENERAL


def test_noise_can_hide_a_translation():
    """The same translation under noise that is larger than its parallax is not claimed."""
    assert classified(shot("truck", parallax=0.001, noise_px=1.0)).kind is not ShotKind.GENERAL


def test_the_gain_grows_with_the_parallax():
    gains = [classified(shot("truck", parallax=parallax)).gain for parallax in (0.0, 0.003, 0.01, 0.03)]
    assert gains == sorted(gains)
    assert -0.05 < gains[0] < 0.3


def test_outliers_do_not_make_a_tripod_move():
    """A twentieth of the tracks follow something that moves through the image."""
    problem = shot("static", points=200)
    o = problem.observations
    actor = o.point % 20 == 0
    o.xy[actor, 0] += 0.01 * o.frame[actor]
    assert classified(problem).kind is ShotKind.STATIC


def test_the_adjustment_is_left_as_it_was():
    problem = shot("truck")
    adjustment = BundleAdjustment(problem.truth, problem.observations, OPTIONS, sigma=0.1)
    state = adjustment.solve()
    before = replace(state, rotation=state.rotation.copy(), translation=state.translation.copy())
    classify_motion(adjustment, problem.observations, OPTIONS)
    np.testing.assert_array_equal(adjustment.state.rotation, before.rotation)
    np.testing.assert_array_equal(adjustment.state.translation, before.translation)
