"""The polish from bad starts: what the incremental map got wrong must not be final."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_problems import angles_between, in_unit_of, make_problem

from factorsfm.converge import converge_cameras, in_front
from factorsfm.images import MappedImage
from factorsfm.initialization import ImageTracks
from factorsfm.options import Options
from factorsfm.polish import polish, with_all_points
from factorsfm.problem import Observations
from factorsfm.reconstruction import FrameStatus, ShotKind
from factorsfm.refinement import BundleAdjustment


def images_of(problem, state):
    """Mapped images with the poses of `state` and the tracks of the problem."""
    images = []
    for k in range(len(state.rotation)):
        ids, xy = problem.of_frame(k)
        image = MappedImage(ImageTracks(k, ids, xy), FrameStatus.REGISTERED, "")
        image.rotation, image.translation = state.rotation[k], state.translation[k]
        images.append(image)
    return images


def reversed_depth(state):
    """Near and far exchanged, the motion turned round."""
    return replace(
        state, translation=-state.translation, inverse_distance=np.clip(2.0 - state.inverse_distance, 0.1, 4)
    )


def bent(state):
    """Points at random distances, and a path that has nothing to do with the true one."""
    rng = np.random.default_rng(1)
    path = 0.03 * rng.standard_normal(state.translation.shape)
    path[0] = 0.0
    return replace(state, translation=path, inverse_distance=rng.uniform(0.3, 2.0, len(state.inverse_distance)))


@pytest.mark.parametrize("damage", [lambda state: state, reversed_depth, bent], ids=["sound", "reversed", "bent"])
@pytest.mark.parametrize("motion", ["truck", "handheld"])
def test_the_truth_is_found_from_a_damaged_map(motion, damage):
    problem = make_problem(motion, frames=12, points=200, parallax=0.05, noise_px=0.1)
    start = damage(problem.truth)
    points = np.arange(len(start.bearing)), start.points
    result = polish(images_of(problem, start), points, np.array([problem.focal]), Options.preset_named("geometry"))
    assert result.motion.kind is ShotKind.GENERAL
    state = in_unit_of(result.state, problem_truth := replace(
        problem.truth,
        bearing=problem.truth.bearing[result.tracks],
        inverse_distance=problem.truth.inverse_distance[result.tracks],
    ))  # fmt: skip
    assert angles_between(state.rotation, problem_truth.rotation).max() < 3e-3
    path = np.linalg.norm(problem_truth.translation, axis=1).max()
    error = np.linalg.norm(state.translation - problem_truth.translation, axis=1).max()
    assert 1e-5 * path < error < 0.1 * path
    assert 0.05 < result.sigma < 0.15
    assert len(result.tracks) > 0.9 * len(start.bearing)


def test_a_scene_behind_the_cameras_is_put_before_them():
    truth = make_problem("truck", frames=4, points=30).truth
    behind = replace(truth, translation=-truth.translation, inverse_distance=-truth.inverse_distance)
    frame, point = (index.ravel() for index in np.indices((4, len(truth.bearing))))
    np.testing.assert_allclose(behind.camera_points(frame, point), truth.camera_points(frame, point))  # as good a fit
    for state in (truth, behind):
        found = in_front(state)
        np.testing.assert_array_equal(found.translation, truth.translation)
        np.testing.assert_array_equal(found.inverse_distance, truth.inverse_distance)


def test_a_long_shot_registers_the_frames_between_on_the_polished_points():
    problem = make_problem("truck", frames=12, points=200, parallax=0.05, noise_px=0.1)
    options = Options.preset_named("geometry")
    options = replace(options, polish=replace(options.polish, max_frames=6))
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    result = polish(images_of(problem, problem.truth), points, np.array([problem.focal]), options)
    assert result.frames == list(range(12))
    assert result.covariance.shape == (12, 6, 6)
    assert angles_between(result.state.rotation, problem.truth.rotation).max() < 1e-3
    assert np.median(result.errors) == pytest.approx(0.118, rel=0.2)


def test_the_tracks_outside_the_core_follow_the_cameras_in_whatever_unit():
    problem = make_problem("truck", frames=12, points=200, parallax=0.1)
    o, truth = problem.observations, problem.truth
    core = np.arange(0, len(truth.bearing), 2)
    short = (o.point % 2 == 1) & (o.frame >= 4)  # the others are seen later, and by fewer
    seen = Observations(o.frame[~short], o.point[~short], o.xy[~short])
    unit = 0.01
    solved = replace(
        truth,
        translation=truth.translation / unit,
        bearing=truth.bearing[core],
        inverse_distance=unit * truth.inverse_distance[core],
    )
    state = with_all_points(solved, solved, seen, core)
    np.testing.assert_allclose(state.bearing, truth.bearing, atol=1e-6)
    np.testing.assert_allclose(state.inverse_distance, unit * truth.inverse_distance, rtol=1e-3)
    np.testing.assert_array_equal(state.translation, solved.translation)


def test_a_solution_under_a_wide_kernel_is_solved_again():
    problem = make_problem("truck", frames=12, points=200, parallax=0.05, noise_px=0.05)
    rng = np.random.default_rng(3)
    seen = problem.observations
    wrong = rng.random(len(seen.xy)) < 0.1  # single observations that are elsewhere
    xy = seen.xy + wrong[:, None] * rng.normal(0.0, 5.0 / problem.focal, seen.xy.shape)
    seen = replace(seen, xy=xy)
    options = Options.preset_named("geometry")
    best = converge_cameras(problem.truth, seen, options)
    found = converge_cameras(bent(problem.truth), seen, options)
    costs = [BundleAdjustment(b.state, seen, options.polish, sigma=0.05).cost() for b in (best, found)]
    assert costs[1] == pytest.approx(costs[0], rel=0.01)
    assert found.sigma == pytest.approx(0.05, rel=0.3)
