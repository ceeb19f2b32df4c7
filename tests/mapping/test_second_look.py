"""A map of several keyframes that explains the scene and a body half: the scene is found later."""

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping import second_look
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.motion.readings import reversed_scene, solution_from
from factorsfm.support.options import MapperOptions, PolishOptions
from tests.estimation_problems import angles_between, make_problem, mapped_images, perturbed
from tests.motion.test_turning import with_follower

KEYFRAMES = 8


def bent_map(keyframes=KEYFRAMES, guided=()):
    """The problem, how many of its points are the scene's, and the map that went with both."""
    problem, scene = with_follower(120, 0.4, frames=keyframes)
    wrong = solution_from(perturbed(problem.truth, structure=0.2), problem.observations, PolishOptions())
    points = PointMap()
    points.set(np.arange(len(problem.points)), wrong.state.points)
    images = mapped_images(problem, wrong.state, guided=guided)
    return problem, scene, MapCopy(images, points, MapperOptions(), problem.focal)


def taken_over(copy, update):
    for image in copy.keyframes:
        image.rotation, image.translation = update.poses.get(image.tracks.position, image.pose)
    copy.points.set(update.ids, update.points)
    copy.points.remove(update.removed)


def error_px(problem, images):
    """Largest error of a rotation, in pixels."""
    found = np.array([image.rotation for image in images])
    return problem.focal * angles_between(found, problem.truth.rotation[: len(found)]).max()


@pytest.mark.parametrize("guided", [(), range(KEYFRAMES)])
def test_the_map_begins_again_with_the_scene(guided):
    problem, scene, copy = bent_map(guided=guided)
    assert error_px(problem, copy.keyframes) > 3.0
    update = update_map(copy, KeyframeGraph())
    assert update.committed
    assert update.begins_again
    assert 100 < update.moving < 140
    assert not (update.ids >= scene).any()
    assert set(range(scene, len(problem.points))) <= set(update.removed.tolist())
    assert sorted(update.poses) == list(range(1, KEYFRAMES))
    taken_over(copy, update)
    assert 1e-4 < error_px(problem, copy.keyframes) < 1.0
    if guided:  # in the unit of the prior, here that of the truth
        depth = np.linalg.norm(update.points, axis=1) * problem.truth.inverse_distance[update.ids]
        assert np.median(depth) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("keyframes", [7, 9])
def test_it_is_looked_at_with_some_keyframes_only(keyframes, monkeypatch):
    monkeypatch.setattr(second_look, "another_reading", lambda *_: pytest.fail("is looked at"))
    _, _, copy = bent_map(keyframes)
    assert not update_map(copy, KeyframeGraph()).begins_again


def test_a_map_that_fits_is_not_looked_at(monkeypatch):
    monkeypatch.setattr(second_look, "another_reading", lambda *_: pytest.fail("is looked at"))
    problem = make_problem("handheld", frames=KEYFRAMES, points=120, parallax=0.02, noise_px=0.25)
    points = PointMap()
    points.set(np.arange(len(problem.points)), problem.points)
    copy = MapCopy(mapped_images(problem, problem.truth), points, MapperOptions(), problem.focal)
    update = update_map(copy, KeyframeGraph())
    assert update.committed
    assert not update.begins_again


def test_the_graph_goes_on_from_what_was_seen_later():
    problem, _, copy = bent_map(9)
    graph = KeyframeGraph()
    for count in (8, 9):
        part = MapCopy(copy.keyframes[:count], copy.points, copy.options, copy.focal)
        update = update_map(part, graph)
        assert update.committed
        assert update.begins_again == (count == KEYFRAMES)
        taken_over(copy, update)
        following = copy.keyframes[count:]
        for image in following:  # registered on the map as it was
            image.rotation, image.translation = copy.keyframes[count - 1].pose
    assert 1e-4 < error_px(problem, copy.keyframes) < 1.0


@pytest.mark.parametrize("exchanged", [False, True])
def test_near_and_far_are_as_they_fit_better(exchanged):
    problem = make_problem("handheld", frames=KEYFRAMES, points=120, parallax=0.1, noise_px=0.1)
    start = reversed_scene(problem.truth) if exchanged else problem.truth
    solved = solution_from(start, problem.observations, PolishOptions())
    found = second_look._nearer_first(solved)
    correlation = np.corrcoef(found.inverse_distance, problem.truth.inverse_distance)[0, 1]
    assert correlation > 0.95
