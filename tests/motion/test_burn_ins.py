"""Captions and logos that stay in the image: left out where they contradict the scene, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping import graph_window, map_update
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.young_map import resting_among
from factorsfm.motion.burn_ins import resting
from factorsfm.polish.camera_starts import best_solution
from factorsfm.support.options import MapperOptions, Options, TrackerOptions
from factorsfm.tracks.flow import FlowTracker
from tests.estimation_problems import angles_between, make_problem, mapped_images, perturbed, with_points

CAPTIONS = 40


def captioned(motion, parallax, count=CAPTIONS, noise_px=0.1, left=-0.4):
    """A problem whose last `count` points rest in the image, right of a line; how many of its points do not."""
    problem = make_problem(motion, frames=16, points=160, parallax=parallax, noise_px=noise_px)
    at = np.random.default_rng(0).uniform([left, -0.25], [0.4, 0.25], (count, 2))
    rays = np.column_stack([at, np.ones(count)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = problem.focal * np.repeat(at[:, None], problem.frames, 1)
    return with_points(problem, rays, pixels), len(problem.points)


def map_with(problem, scene, cameras, keyframes):
    """A map of some of the frames, the captions among its points, far away."""
    images = mapped_images(problem, cameras)
    points = PointMap()
    far = np.where(np.arange(len(problem.points)) < scene, 1.0, 30.0)[:, None]
    points.set(np.arange(len(problem.points)), problem.points * far)
    return MapCopy([images[k] for k in keyframes], points, MapperOptions(), problem.focal)


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
    near = perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03)
    update = update_map(map_with(problem, scene, near, (0, 3, 6, 9)), KeyframeGraph())
    assert update.committed
    captions = np.arange(scene, len(problem.points)) if found else np.zeros(0, np.int64)
    np.testing.assert_array_equal(update.burn_ins, captions)
    assert np.isin(captions, update.removed).all()
    assert not np.isin(captions, update.ids).any()


def captions_beside(left, noise_px=0.1):
    """60 points that rest right of a line, and a scene that is seen left of it only."""
    problem, scene = captioned("handheld", 0.05, 60, noise_px, left)
    o = problem.observations
    kept = np.flatnonzero((o.pixels[o.first, 0] < problem.focal * left) | (np.arange(len(problem.points)) >= scene))
    return replace(problem, truth=problem.truth.of(kept), points=problem.points[kept], observations=o.of(kept))


@pytest.mark.parametrize(
    ("left", "noise_px", "found"), [(0.3, 0.2, True), (0.1, 0.1, True), (0.1, 0.2, False), (0.1, 0.4, True)]
)
def test_what_rests_on_much_of_the_image_bends_the_map_only_if_the_rest_fits_or_fits_far_better(
    left, noise_px, found, monkeypatch
):
    """0.7, 0.6, 0.8 and 0.3 of the cost, of which the last three are on more of the image than captions are."""
    monkeypatch.setattr(map_update, "fits_pose", lambda image, ids, *_: np.ones(len(ids), bool))  # a map that they bent
    problem = captions_beside(left, noise_px)
    copy = map_with(problem, len(problem.points) - 60, problem.truth, (0, 3, 6, 9))
    assert len(update_map(copy, KeyframeGraph()).burn_ins) == (60 if found else 0)


@pytest.mark.parametrize(("left", "found"), [(0.3, 60), (0.1, 0)])
def test_what_contradicts_and_rests_on_much_of_the_image_may_be_the_scene(left, found):
    problem = captions_beside(left)
    ids = np.arange(len(problem.points))
    suspects = ids >= len(ids) - 60
    assert len(resting_among(mapped_images(problem, problem.truth), ids, suspects, problem.focal)) == found


def test_captions_take_nothing_else_out_of_an_old_map(monkeypatch):
    """Points that the graph has no room for stay in the map."""
    problem, scene = captioned("handheld", 0.05)
    near = perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03)
    copy = map_with(problem, scene, near, range(8))
    outside = np.arange(30)  # the newest keyframe does not see them
    copy.newest.forget_tracks(outside)
    monkeypatch.setattr(graph_window, "_MOST_LANDMARKS", len(problem.points) - len(outside))
    monkeypatch.setattr(map_update, "fits_pose", lambda image, ids, *_: np.ones(len(ids), bool))  # a map that they bent
    update = update_map(copy, KeyframeGraph())
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
