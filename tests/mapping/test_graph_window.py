"""Which landmarks the graph solves for, and the points that are solved alone with its poses."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping import graph_window
from factorsfm.mapping.depth_guidance import DepthGuidance
from factorsfm.mapping.graph_window import choose_landmarks, measured_window, window_rows
from factorsfm.mapping.landmarks import solve_alone
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.support.options import MapperOptions
from factorsfm.support.status import FrameStatus
from tests.estimation_problems import angles_between, make_problem, mapped_images, perturbed, tracks_at

OPTIONS = MapperOptions(landmarks=200)


def image_of(position, ids):
    tracks = tracks_at(position, np.asarray(ids), np.zeros((len(ids), 2)))
    return MappedImage(tracks, FrameStatus.REGISTERED, "", np.eye(3), np.zeros(3))


def map_of(points):
    mapped = PointMap()
    mapped.set(np.arange(len(points)), points)
    return mapped


def test_few_landmarks_are_all_in_the_graph():
    ids = np.arange(900)
    inside, outside = choose_landmarks([image_of(0, ids), image_of(1, ids)], ids, set())
    np.testing.assert_array_equal(inside, ids)
    assert len(outside) == 0


def test_of_many_landmarks_the_newest_keyframe_s_come_first_and_then_what_most_keyframes_see():
    ids = np.arange(1300)
    seen = [ids, ids[:1000], ids[:800], ids[1200:]]  # the newest keyframe sees what hardly any other does
    inside, outside = choose_landmarks([image_of(k, mine) for k, mine in enumerate(seen)], ids, set())
    np.testing.assert_array_equal(inside, np.r_[ids[:800], ids[1200:]])
    np.testing.assert_array_equal(outside, ids[800:1200])


def test_of_too_many_in_the_newest_keyframe_those_with_most_views_are_in_the_graph():
    ids = np.arange(1000)
    inside, outside = choose_landmarks([image_of(0, ids[100:]), image_of(1, ids)], ids, set())
    np.testing.assert_array_equal(inside, ids[100:])
    np.testing.assert_array_equal(outside, ids[:100])


def test_those_that_share_most_with_the_newest_are_constant_beside_what_is_free():
    shared, free = np.array([40, 29, 90, 60, 50, 0]), np.array([False, False, True, False, False, True])
    rows, constant = window_rows(shared, free, 2)
    np.testing.assert_array_equal(rows, [2, 3, 4, 5])
    np.testing.assert_array_equal(constant, [False, True, True, False])
    rows, constant = window_rows(shared, free, 8)
    np.testing.assert_array_equal(rows, [0, 2, 3, 4, 5])  # too little is shared with the second
    np.testing.assert_array_equal(constant, [True, False, True, True, False])


def test_two_cameras_are_constant_unless_all_are_free():
    rows, constant = window_rows(np.array([40, 20, 90, 60]), np.array([False, False, True, True]), 8)
    np.testing.assert_array_equal(rows, [0, 2, 3])
    np.testing.assert_array_equal(constant, [True, True, False])
    rows, constant = window_rows(np.array([40, 50, 0]), np.ones(3, bool), 8)
    np.testing.assert_array_equal(rows, [0, 1, 2])
    assert not constant.any()


def handheld(noise_px=0.0):
    problem = make_problem("handheld", frames=6, points=120, parallax=0.1, noise_px=noise_px)
    return problem, perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03)


@pytest.mark.parametrize("guided", [(), (0, 3)])
def test_points_that_are_solved_alone_follow_the_new_poses(guided):
    """Exact data gives exact points."""
    problem, near = handheld()
    images = mapped_images(problem, near, guided=guided)
    n, truth = len(problem.points), problem.truth
    inside, outside = np.arange(n // 2), np.arange(n // 2, n)
    for k in guided:
        images[k].affine = (1.1, 0.0)  # that of the update holds
    poses = {k: (truth.rotation[k], truth.translation[k]) for k in range(6)}
    update = MapUpdate(
        5,
        None,
        True,
        "committed",
        inside,
        problem.points[inside],
        np.array([1000]),
        poses,
        dict.fromkeys(guided, (1.0, 0.0)),
    )
    copy = MapCopy(images, map_of(near.points), OPTIONS, problem.focal)
    before = [image.pose for image in images]
    moved = solve_alone(copy, images, update, outside, DepthGuidance(OPTIONS, copy.points), outside[:0])
    np.testing.assert_array_equal(moved.ids, np.arange(n))
    np.testing.assert_array_equal(moved.points[inside], problem.points[inside])
    np.testing.assert_array_equal(moved.removed, [1000])
    started = np.linalg.norm(near.points[outside] - problem.points[outside], axis=1)
    left = np.linalg.norm(moved.points[outside] - problem.points[outside], axis=1)
    assert np.median(started) > 0.01
    assert left.max() < 1e-4
    for image, pose in zip(images, before, strict=True):
        assert image.pose[0] is pose[0]
        assert image.pose[1] is pose[1]
    np.testing.assert_array_equal(copy.points.at(outside), near.points[outside])


@pytest.mark.parametrize(("contradicting", "kept"), [(0, 2), (10, 1)])
def test_a_point_that_holds_nowhere_is_removed_outside_of_the_graph_too(contradicting, kept):
    """One that did not fit before has to fit better than others."""
    problem, _ = handheld()
    images = mapped_images(problem, problem.truth)
    rng, n = np.random.default_rng(0), len(problem.points)
    for k, image in enumerate(images):
        image.tracks.pixels[n - 1] = [320, 180] + problem.focal * rng.uniform(-0.3, 0.3, 2)
        image.tracks.pixels[n - 2] += [0.0, 6.0 * (-1) ** k]
    copy = MapCopy(images, map_of(problem.points), OPTIONS, problem.focal)
    update = solve_alone(
        copy, images, MapUpdate(5, None, True, "committed"), np.arange(n - 10, n), DepthGuidance(OPTIONS, copy.points),
        np.arange(n - contradicting, n),
    )  # fmt: skip
    np.testing.assert_array_equal(update.ids, np.arange(n - 10, n - 3 + kept))
    np.testing.assert_array_equal(update.removed, np.arange(n - 3 + kept, n))


def test_what_contradicts_the_pose_of_the_new_keyframe_does_not_bend_the_map():
    problem, _ = handheld(noise_px=0.05)
    n = len(problem.points)
    scene, walker = np.arange(n - 30), np.arange(n - 30, n)
    images = mapped_images(problem, problem.truth)
    for k, image in enumerate(images):
        image.tracks.pixels[walker] += [4.0 * k, 0.0]
    copy = MapCopy(images, map_of(problem.points), OPTIONS, problem.focal)
    update = update_map(copy, KeyframeGraph())
    np.testing.assert_array_equal(update.ids, scene)
    np.testing.assert_array_equal(update.removed, walker)
    turn = [angles_between(r[None], problem.truth.rotation[k][None])[0] for k, (r, _) in update.poses.items()]
    assert 1e-6 < max(turn) < 1e-4


def test_an_update_brings_the_points_outside_of_the_graph_along(monkeypatch):
    problem, near = handheld(noise_px=0.05)
    n, found = len(problem.points), []
    for most in (900, 60):
        monkeypatch.setattr(graph_window, "_MOST_LANDMARKS", most)
        images = [replace(image) for image in mapped_images(problem, near)]
        copy = MapCopy(images, map_of(near.points), OPTIONS, problem.focal)
        update = update_map(copy, graph := KeyframeGraph())
        assert update.committed
        np.testing.assert_array_equal(update.ids, np.arange(n))
        keys = graph._live._isam.getLinearizationPoint().keys()
        assert sum(key >> 56 == ord("l") for key in keys) == min(n, most)
        unit = np.median(np.linalg.norm(update.points, axis=1) * problem.truth.inverse_distance)
        relative = np.linalg.norm(update.points / unit - problem.points, axis=1) * problem.truth.inverse_distance
        turn = [angles_between(r[None], problem.truth.rotation[k][None])[0] for k, (r, _) in update.poses.items()]
        found.append((np.median(relative[: n // 2]), np.median(relative[n // 2 :]), max(turn)))
    assert (np.array(found) < [0.02, 0.02, 5e-4]).all(), found
    assert (np.array(found) > [1e-4, 1e-4, 1e-6]).all(), found


def test_a_window_has_the_observations_and_the_prior_of_its_landmarks():
    problem, near = handheld()
    images = mapped_images(problem, near, guided=(1, 4), scale=1.2, shift=0.1)
    images[4].affine = (2.0, 0.3)
    ids = np.arange(5, 60)
    constant = np.arange(6) < 2
    window = measured_window(images, constant, ids, map_of(near.points), problem.focal, OPTIONS)
    assert len(window.frame) == 6 * len(ids)
    exact = replace(
        window, rotation=problem.truth.rotation, translation=problem.truth.translation, points=problem.points[ids]
    )
    np.testing.assert_allclose(exact.reprojection()[0], 0.0, atol=1e-8)
    d = window.depths
    np.testing.assert_array_equal(d.image, [1, 4])
    np.testing.assert_array_equal(d.scale, [1.0, 2.0])
    np.testing.assert_array_equal(d.shift, [0.0, 0.3])
    assert len(d.inverse_depth) == 2 * len(ids)
    depth = np.array(
        [problem.depth(window.keyframes[d.image[r]], [ids[p]])[0] for r, p in zip(d.row, d.point, strict=True)]
    )
    np.testing.assert_allclose(d.inverse_depth, 1.2 / depth + 0.1)
    np.testing.assert_allclose(d.sigma, 0.6 * np.sqrt(2) * d.scale[d.row])  # two images repeat the same error
