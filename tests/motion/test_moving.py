"""What moves by itself: left out where it bends the cameras, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.motion.moving import as_exact, bounded_costs, far_off, largest_cost, moving_together, standing_out
from factorsfm.polish.camera_starts import best_solution, on_what_fits
from factorsfm.support.options import Options, PolishOptions
from factorsfm.tracks.flow import _moves_otherwise
from tests.estimation_problems import angles_between, centers, in_unit_of, make_problem, perturbed, with_points

WALKER = 24


def with_walker(parallax, count=WALKER):
    """A problem whose last `count` points cross the image on a rigid body; how many are the scene's; the body's way."""
    problem = make_problem("handheld", frames=16, points=160, parallax=parallax, noise_px=0.1)
    truth, k = problem.truth, problem.frames
    rng = np.random.default_rng(0)
    body = rng.uniform([-0.12, -0.2, 0.75], [0.0, 0.2, 0.85], (count, 3))
    way = np.linspace(0.0, 1.0, k)[:, None] * [0.3, 0.02, 0.05]
    seen = np.einsum("kij,nkj->nki", truth.rotation, body[:, None] + way) + truth.translation
    xy = seen[..., :2] / seen[..., 2:] * problem.focal + problem.noise_px * rng.standard_normal((count, k, 2))
    return with_points(problem, body, xy), len(problem.points), way


def path_error(solved, problem, scene):
    """Largest distance of a camera from the truth, in units of the median distance of the scene."""
    truth = problem.truth.of(np.arange(scene))
    state = in_unit_of(solved.state, truth)
    return np.linalg.norm(
        centers(state.rotation, state.translation) - centers(truth.rotation, truth.translation), axis=1
    ).max()


@pytest.mark.parametrize("parallax", [0.05, 0.1])
def test_a_walker_does_not_bend_the_cameras(parallax):
    problem, scene, _ = with_walker(parallax)
    found = best_solution(perturbed(problem.truth, structure=0.2), problem.observations, Options())
    np.testing.assert_array_equal(found.kept, np.arange(scene))
    assert found.moving == WALKER
    error_px = problem.focal * angles_between(found.adjustment.state.rotation, problem.truth.rotation)
    assert 0.01 < error_px.max() < 0.4
    assert 1e-5 < path_error(found.adjustment, problem, scene) < 0.002


@pytest.mark.parametrize(("parallax", "count"), [(0.02, WALKER), (0.1, WALKER), (0.05, 200), (0.1, 300)])
def test_a_map_that_went_with_the_walker_is_given_up(parallax, count):
    # All that is seen fits such a path better than the right one, under a kernel that has no bound. A walker of dense
    # texture has most of the tracks, but the scene is seen in most of the image.
    problem, scene, way = with_walker(parallax, count)
    with_it = replace(problem.truth, translation=problem.truth.translation + way)
    found = best_solution(with_it, problem.observations, Options())
    np.testing.assert_array_equal(found.kept, np.arange(scene))
    assert 1e-5 < path_error(found.adjustment, problem, scene) < 0.002


@pytest.mark.parametrize(("parallax", "count"), [(0.02, 70), (0.05, 90), (0.1, 70), (0.1, 150)])
def test_a_good_map_is_not_led_away_by_many_tracks(parallax, count):
    # Half of the tracks are the walker's, or more: solved with all of them, the cameras go with it, and nothing of it
    # stands out any more.
    problem, scene, _ = with_walker(parallax, count)
    start = perturbed(problem.truth, angle_rad=1e-4, shift=1e-3, structure=0.02)
    found = best_solution(start, problem.observations, Options())
    np.testing.assert_array_equal(found.kept, np.arange(scene))
    assert found.moving == count
    assert found.rival < 0.9  # two readings with the same scene are no rivals
    error_px = problem.focal * angles_between(found.adjustment.state.rotation, problem.truth.rotation)
    assert 0.01 < error_px.max() < 0.3


def test_what_a_good_map_explains_is_found_beside_more_that_moves():
    problem, scene, _ = with_walker(0.05, 160)
    start = perturbed(problem.truth, angle_rad=1e-4, shift=1e-3, structure=0.02)
    found = on_what_fits(start, problem.observations, Options(), 0.25)
    np.testing.assert_array_equal(found.kept, np.arange(scene))
    assert found.moving == 160


def test_tracks_that_slide_are_kept():
    # They stand out one by one, but nothing fits better without them.
    problem = make_problem("handheld", frames=16, points=160, parallax=0.05, noise_px=0.1)
    o = problem.observations
    slides = o.point % 8 == 0
    rng = np.random.default_rng(1)
    way = rng.normal(0.0, 4.0, (len(problem.points), 2))[o.point] * np.sin(0.5 * o.frame[:, None])
    seen = replace(o, pixels=o.pixels + slides[:, None] * way)
    found = best_solution(problem.truth, seen, Options())
    assert standing_out(found.adjustment).sum() >= 8
    assert (len(found.kept), found.moving) == (len(problem.points), 0)


@pytest.mark.parametrize(("count", "known"), [(120, 0), (24, 12), (8, 8)])
def test_a_walker_is_a_thing_and_tracks_that_slide_are_none(count, known):
    """A few of its tracks among those of the scene, as if it were of glass, must be known."""
    problem, scene, _ = with_walker(0.05, count)
    o = problem.observations
    slides = (np.arange(scene + count) % 8 == 0) & (np.arange(scene + count) < scene)
    rng = np.random.default_rng(1)
    way = rng.normal(0.0, 4.0, (len(slides), 2))[o.point] * np.sin(0.5 * o.frame[:, None])
    seen = replace(o, pixels=o.pixels + slides[o.point, None] * way)
    solved = BundleAdjustment(problem.truth, seen, PolishOptions(), ErrorModel(0.1))
    core, left_out = np.flatnonzero(~slides[:scene]), np.arange(scene, scene + known)
    moves = moving_together(seen, solved.reprojection_errors(), 0.1, rests_on=core, left_out=left_out)
    assert moves[scene:].mean() > 0.9
    assert moves[core].sum() == 0
    assert moves[:scene].sum() <= 8  # that slide beside the walker
    alone = BundleAdjustment(
        problem.truth.of(np.arange(scene)), seen.of(np.arange(scene)), PolishOptions(), ErrorModel(0.1)
    )
    errors = alone.reprojection_errors()
    assert not moving_together(alone.observations, errors, 0.1, rests_on=core, left_out=core[:0]).any()


def test_few_points_do_no_harm():
    problem, scene, _ = with_walker(0.05, count=7)
    solved = BundleAdjustment(problem.truth, problem.observations, PolishOptions(), ErrorModel(0.1))
    assert not standing_out(solved).any()
    problem, scene, _ = with_walker(0.05, count=8)
    solved = BundleAdjustment(problem.truth, problem.observations, PolishOptions(), ErrorModel(0.1))
    np.testing.assert_array_equal(np.flatnonzero(standing_out(solved)), np.arange(scene, scene + 8))


def test_where_errors_are_widely_spread_all_that_is_far_off_is_found():
    """Beside a walker with a third of the tracks, and tracks of the scene of all sorts."""
    problem, scene, _ = with_walker(0.05, count=80)
    o = problem.observations
    rng = np.random.default_rng(2)
    worse = np.where(np.arange(scene + 80) < scene // 3, 10.0 ** rng.uniform(-1.0, 0.0, scene + 80), 0.0)
    seen = replace(o, pixels=o.pixels + worse[o.point, None] * rng.standard_normal(o.pixels.shape))
    solved = BundleAdjustment(problem.truth, seen, PolishOptions(), ErrorModel(0.15))
    assert standing_out(solved)[scene:].mean() < 0.5
    assert far_off(solved)[scene:].mean() > 0.95
    assert not far_off(solved)[:scene].any()


def test_what_stands_out_costs_no_more_than_what_is_left_out():
    problem, scene, _ = with_walker(0.05)
    o = problem.observations
    costs = bounded_costs(BundleAdjustment(problem.truth, o, PolishOptions(), ErrorModel(0.1)), 0.1)
    walks = o.point >= scene
    assert largest_cost(PolishOptions().kernel) == pytest.approx(2.0 * np.log1p(25.0))
    assert costs.max() == largest_cost(PolishOptions().kernel)
    # Of the walker's first frames something fits: it begins where the state has it.
    assert 0.85 < costs[walks].mean() / costs.max() < 1.0
    assert costs[~walks].mean() < 1.2


def test_what_is_as_exact_as_the_members_joins_them():
    problem, scene, _ = with_walker(0.05)
    solved = BundleAdjustment(problem.truth, problem.observations, PolishOptions(), ErrorModel(0.1))
    members = np.arange(scene + WALKER) < scene // 2
    joined = as_exact(solved, members)
    assert joined[members].all()
    assert joined[scene // 2 : scene].mean() > 0.95
    assert not joined[scene:].any()


def test_the_patches_of_the_scene_do_not_follow_a_walker():
    old = np.random.default_rng(0).uniform(0.0, [320.0, 180.0], (200, 2)).astype(np.float32)
    walks = np.abs(old[:, 0] - 160.0) < 25.0
    new = old + np.where(walks[:, None], [9.0, 0.0], [1.0, 0.5]).astype(np.float32) + 0.002 * old
    np.testing.assert_array_equal(_moves_otherwise(old, new, 320), walks)
    assert not _moves_otherwise(old[~walks], new[~walks], 320).any()
