"""The polish from bad starts: what the incremental map got wrong must not be final."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.mapping.all_points import with_all_points
from factorsfm.motion.readings import in_front
from factorsfm.polish.camera_starts import best_solution
from factorsfm.polish.connected_frames import connected_frames
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus, ShotKind
from tests.estimation_problems import angles_between, in_unit_of, make_problem, mapped_images, tracks_at


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
    result = polish(
        Shot.of(mapped_images(problem, start), points, np.array([problem.focal])), Options.preset_named("geometry")
    )
    assert result.motion.kind is ShotKind.GENERAL
    state = in_unit_of(result.state, problem_truth := replace(
        problem.truth,
        bearing=problem.truth.bearing[result.tracks],
        inverse_distance=problem.truth.inverse_distance[result.tracks],
    ))  # fmt: skip
    assert angles_between(state.rotation, problem_truth.rotation).max() < 6e-4
    path = np.linalg.norm(problem_truth.translation, axis=1).max()
    error = np.linalg.norm(state.translation - problem_truth.translation, axis=1).max()
    assert 1e-3 * path < error < 0.012 * path
    assert 0.08 < result.sigma < 0.1
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
    result = polish(Shot.of(mapped_images(problem, problem.truth), points, np.array([problem.focal])), options)
    assert result.frames == list(range(12))
    assert result.covariance.shape == (12, 6, 6)
    assert angles_between(result.state.rotation, problem.truth.rotation).max() < 7e-4
    assert (
        0.095 < np.median(result.errors) < 0.118
    )  # pixels: the median of two Gaussian errors, of which some are fitted


def test_the_tracks_outside_the_core_follow_the_cameras_in_whatever_unit():
    problem = make_problem("truck", frames=12, points=200, parallax=0.1)
    o, truth = problem.observations, problem.truth
    core = np.arange(0, len(truth.bearing), 2)
    short = (o.point % 2 == 1) & (o.frame >= 4)  # the others are seen later, and by fewer
    seen = Observations(o.frame[~short], o.point[~short], o.pixels[~short])
    unit = 0.01
    solved = replace(
        truth,
        translation=truth.translation / unit,
        bearing=truth.bearing[core],
        inverse_distance=unit * truth.inverse_distance[core],
    )
    state = with_all_points(solved, solved, seen, core)
    np.testing.assert_allclose(state.bearing, truth.bearing, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(state.inverse_distance, unit * truth.inverse_distance, rtol=1e-9)
    np.testing.assert_array_equal(state.translation, solved.translation)


def test_a_solution_under_a_wide_kernel_is_solved_again():
    problem = make_problem("truck", frames=12, points=200, parallax=0.05, noise_px=0.05)
    rng = np.random.default_rng(3)
    seen = problem.observations
    wrong = rng.random(len(seen.pixels)) < 0.1  # single observations that are elsewhere
    pixels = seen.pixels + wrong[:, None] * rng.normal(0.0, 5.0, seen.pixels.shape)
    seen = replace(seen, pixels=pixels)
    options = Options.preset_named("geometry")
    best = best_solution(problem.truth, seen, options).adjustment
    found = best_solution(bent(problem.truth), seen, options).adjustment
    costs = [BundleAdjustment(b.state, seen, options.polish, ErrorModel(0.05)).cost() for b in (best, found)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-4)
    assert found.sigma == pytest.approx(0.048, rel=0.05)


def with_dark_frames(images, dark, kept=0):
    """Tracks of their own in some images, of which most wander about; `kept` of the others' tracks remain in them.

    As in a fade: what is tracked in the dark is noise, and does not go on in the light.
    """
    rng = np.random.default_rng(2)
    for k in dark:
        tracks = images[k].tracks
        ids = np.concatenate([tracks.ids[:kept], 10_000 + np.arange(300)])
        noise = rng.uniform(-0.4, 0.4, (300, 2))
        images[k].tracks = tracks_at(k, ids, np.concatenate([tracks.xy[:kept], noise]))
    return images


@pytest.mark.parametrize(
    ("dark", "kept"),
    [([0, 1, 2, 3, 4], 0), ([0, 1, 2, 3, 4], 14), ([10, 11, 12, 13, 14], 3), ([5, 6, 7, 8, 9], 0), ([7], 0)],
    ids=["begin", "begin, almost enough", "end", "middle", "one"],
)
@pytest.mark.parametrize("motion", ["truck", "rotation"])
def test_frames_that_no_track_holds_are_left_out_and_change_nothing(motion, dark, kept):
    problem = make_problem(motion, frames=15, points=200, parallax=0.05, noise_px=0.1)
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    options, focal = Options.preset_named("geometry"), np.array([problem.focal])
    result = polish(
        Shot.of(with_dark_frames(mapped_images(problem, problem.truth), dark, kept), points, focal), options
    )
    light = [k for k in range(15) if k not in dark]
    assert result.frames == light
    assert {k: why.split(" needed")[0] for k, why in result.left_out.items()} == dict.fromkeys(dark, f"{kept} of 15")
    only = mapped_images(problem, problem.truth)
    for k in dark:
        only[k].forget(FrameStatus.BLANK, "")
    alone = polish(Shot.of(only, points, focal), options)
    assert not alone.left_out
    np.testing.assert_allclose(result.state.rotation, alone.state.rotation, atol=1e-6)
    np.testing.assert_allclose(result.state.translation, alone.state.translation, atol=1e-6)
    np.testing.assert_allclose(result.covariance, alone.covariance, rtol=0.02, atol=1e-12)
    np.testing.assert_allclose(result.state.rotation[0], np.eye(3), atol=1e-12)
    assert all((np.diag(block) > 0).any() for block in result.covariance[1:])
    assert not result.covariance[0].any()  # it is the world


def test_a_weak_first_camera_is_the_world_but_does_not_spoil_the_others():
    problem = make_problem("truck", frames=15, points=200, parallax=0.05, noise_px=0.1)
    images = with_dark_frames(mapped_images(problem, problem.truth), [0], kept=16)
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    result = polish(Shot.of(images, points, np.array([problem.focal])), Options.preset_named("geometry"))
    assert result.frames == list(range(15))
    np.testing.assert_allclose(result.state.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(result.state.translation[0], 0.0, atol=1e-12)
    relative = result.state.rotation @ result.state.rotation[7].T
    truth = problem.truth.rotation @ problem.truth.rotation[7].T
    errors = angles_between(relative, truth)
    assert 5e-5 < errors[1:].max() < 4e-4
    assert 7e-5 < errors[0] < 6e-4
    assert np.isfinite(result.covariance).all()


def test_without_tracks_that_join_frames_there_is_no_result():
    problem = make_problem("truck", frames=6, points=200, noise_px=0.1)
    images = mapped_images(problem, problem.truth)
    for k, image in enumerate(images):
        image.tracks = replace(image.tracks, ids=image.tracks.ids + 1000 * k)
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    with pytest.raises(ReconstructionError, match="0 of 6 frames have enough tracks that agree"):
        polish(Shot.of(images, points, np.array([problem.focal])), Options.preset_named("geometry"))


def test_the_larger_part_of_what_falls_apart_is_kept():
    """Two groups of frames that share too few points, and one frame without any."""
    few, many, bridge = np.arange(40), np.arange(40, 80), np.arange(80, 86)
    seen = [np.r_[few, bridge]] * 3 + [many[:0]] + [np.r_[many, bridge]] * 4
    frame = np.repeat(np.arange(8), [len(s) for s in seen])
    point = np.concatenate(seen)
    order = np.lexsort((frame, point))
    observations = Observations(frame[order], point[order], np.zeros((len(point), 2)))
    once, worth = np.ones(86, int), np.where(np.arange(86) < 80, 1, 3)
    joined, shared = connected_frames(observations, 8, 15, once)
    np.testing.assert_array_equal(joined, [False] * 4 + [True] * 4)
    np.testing.assert_array_equal(shared, [6, 6, 6, 0, 46, 46, 46, 46])
    np.testing.assert_array_equal(connected_frames(observations, 8, 6, once)[0], [True] * 3 + [False] + [True] * 4)
    joined, shared = connected_frames(observations, 8, 15, worth)
    np.testing.assert_array_equal(joined, [True] * 3 + [False] + [True] * 4)
    np.testing.assert_array_equal(shared, [58, 58, 58, 0, 58, 58, 58, 58])


@pytest.mark.parametrize("motion", ["rotation", "static"])
def test_frames_between_do_not_translate_where_the_others_do_not(motion):
    problem = make_problem(motion, frames=24, points=200, noise_px=0.1)
    options = Options.preset_named("geometry")
    options = replace(options, polish=replace(options.polish, max_frames=6))
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    result = polish(Shot.of(mapped_images(problem, problem.truth), points, np.array([problem.focal])), options)
    assert result.motion.kind == motion
    assert len(result.frames) == 24
    assert not result.state.translation.any()
    error_px = problem.focal * angles_between(result.state.rotation, problem.truth.rotation)
    assert 0.001 < error_px.max() < 0.2
