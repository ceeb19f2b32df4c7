"""Captions and logos that stay in the image: left out where they contradict the scene, and only there."""

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping import graph_window, map_update
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.motion.burn_ins import resting
from factorsfm.polish.camera_starts import best_solution
from factorsfm.support.options import MapperOptions, Options, TrackerOptions
from factorsfm.tracks.flow import FlowTracker
from tests.estimation_problems import angles_between, make_problem, mapped_images, perturbed, with_points

CAPTIONS = 40


def captioned(motion, parallax, count=CAPTIONS):
    """A problem whose last `count` points rest in the image; how many of its points do not."""
    problem = make_problem(motion, frames=16, points=160, parallax=parallax, noise_px=0.1)
    at = np.random.default_rng(0).uniform([-0.4, -0.25], [0.4, 0.25], (count, 2))
    rays = np.column_stack([at, np.ones(count)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = problem.focal * np.repeat(at[:, None], problem.frames, 1)
    return with_points(problem, rays, pixels), len(problem.points)


@pytest.mark.parametrize(("count", "found"), [(CAPTIONS, CAPTIONS), (5, 0)])
def test_only_what_rests_is_suspected_and_not_a_few_points(count, found):
    problem, scene = captioned("handheld", 0.05, count)
    suspects = resting(problem.observations)
    assert (suspects[:scene].sum(), suspects[scene:].sum()) == (0, found)


def test_nothing_rests_where_the_camera_does():
    problem, _ = captioned("static", 0.0)
    assert not resting(problem.observations).any()


@pytest.mark.parametrize("parallax", [0.02, 0.05])
def test_captions_do_not_bend_the_cameras(parallax):
    # With the captions, the best fit is 16 pixels off.
    problem, scene = captioned("handheld", parallax)
    found = best_solution(perturbed(problem.truth, structure=0.2), problem.observations, Options())
    core, solved = found.kept, found.adjustment
    np.testing.assert_array_equal(core, np.arange(scene))
    error_px = problem.focal * angles_between(solved.state.rotation, problem.truth.rotation)
    assert 0.01 < error_px.max() < 0.3


@pytest.mark.parametrize(("motion", "parallax"), [("truck", 0.05), ("dolly", 0.1)])
def test_what_may_be_far_away_is_kept(motion, parallax):
    problem, _ = captioned(motion, parallax)
    found = best_solution(perturbed(problem.truth, structure=0.2), problem.observations, Options())
    core, solved = found.kept, found.adjustment
    assert len(core) == len(problem.points)
    error_px = problem.focal * angles_between(solved.state.rotation, problem.truth.rotation)
    assert 0.01 < error_px.max() < 0.3


@pytest.mark.parametrize(("motion", "found"), [("handheld", True), ("truck", False)])
def test_the_map_takes_captions_out_at_once(motion, found):
    problem, scene = captioned(motion, 0.05)
    images = mapped_images(problem, perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03))
    points = PointMap()
    far = np.where(np.arange(len(problem.points)) < scene, 1.0, 30.0)[:, None]
    points.set(np.arange(len(problem.points)), problem.points * far)
    keyframes = [images[k] for k in (0, 3, 6, 9)]
    update = update_map(MapCopy(keyframes, points, MapperOptions(), problem.focal), KeyframeGraph())
    assert update.committed
    captions = np.arange(scene, len(problem.points)) if found else np.zeros(0, np.int64)
    np.testing.assert_array_equal(update.burn_ins, captions)
    assert np.isin(captions, update.removed).all()
    assert not np.isin(captions, update.ids).any()


def test_captions_take_nothing_else_out_of_an_old_map(monkeypatch):
    """Points that the graph has no room for stay in the map."""
    problem, scene = captioned("handheld", 0.05)
    images = mapped_images(problem, perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03))[:8]
    outside = np.arange(30)  # the newest keyframe does not see them
    images[-1].forget_tracks(outside)
    monkeypatch.setattr(graph_window, "_MOST_LANDMARKS", len(problem.points) - len(outside))
    monkeypatch.setattr(map_update, "fits_pose", lambda image, ids, *_: np.ones(len(ids), bool))  # a map that they bent
    points = PointMap()
    far = np.where(np.arange(len(problem.points)) < scene, 1.0, 30.0)[:, None]
    points.set(np.arange(len(problem.points)), problem.points * far)
    update = update_map(MapCopy(images, points, MapperOptions(), problem.focal), KeyframeGraph())
    assert update.committed
    np.testing.assert_array_equal(update.burn_ins, np.arange(scene, len(problem.points)))
    np.testing.assert_array_equal(update.removed, update.burn_ins)
    np.testing.assert_array_equal(update.ids, np.arange(scene))


def test_no_track_starts_again_on_a_caption():
    image = np.random.default_rng(0).integers(0, 256, (180, 320), np.uint8)
    tracker = FlowTracker(TrackerOptions(max_tracks=200))
    first = tracker.track(image)
    captions = first.xy[:, 0] < 160
    tracker.avoid(first.ids[captions])
    for _ in range(4):
        later = tracker.track(image)
    assert set(first.ids[~captions]) <= set(later.ids)
    nearest = np.linalg.norm(later.xy[:, None] - first.xy[captions], axis=2).min()
    assert nearest > 0.5 * tracker.options.window_px
