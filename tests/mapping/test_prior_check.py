"""Whether depth maps agree with each other, on synthetic keyframes whose depths are known."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.prior_check import inconsistency
from factorsfm.support.options import MapperOptions
from tests.estimation_problems import make_problem, mapped_images


def keyframes(frames=5, *, shuffled=(), **prior):
    """Keyframes with a prior; that of some is given to the wrong points."""
    problem = make_problem("handheld", frames=frames, points=120, parallax=0.05)
    images = mapped_images(problem, problem.truth, guided=range(frames), **prior)
    for k in shuffled:
        tracks = images[k].tracks
        order = np.random.default_rng(k).permutation(len(tracks.ids))
        images[k].tracks = replace(tracks, depth=tracks.depth.of(order))
    return problem, images


@pytest.mark.parametrize("prior", [{"scale": 2.0, "shift": 0.5}, {"scale": -1.0, "shift": 5.0}, {"noise": 0.1}])
def test_maps_of_one_scene_agree_whatever_they_say_of_it(prior):
    assert inconsistency(keyframes(**prior)[1]) == ""


def test_maps_of_nothing_disagree_and_the_number_is_named():
    reason = inconsistency(keyframes(shuffled=range(5))[1])
    assert reason.startswith("the order of its depths correlates from keyframe to keyframe by ")
    assert reason.endswith(", at least 0.25 expected")
    assert abs(float(reason.split()[-5].rstrip(","))) < 0.05


def test_one_bad_map_is_an_accident():
    assert inconsistency(keyframes(6, shuffled=[3])[1]) == ""  # it spoils two of five pairs


@pytest.mark.parametrize(("noise", "told"), [(0.01, False), (0.3, True)])
def test_a_wall_has_no_order_of_depths_to_contradict(noise, told):
    _, images = keyframes()
    for k, image in enumerate(images):
        said = image.tracks.depth.inverse_depth
        wall = 2.0 * (1.0 + noise * np.random.default_rng(k).standard_normal(len(said)))
        image.tracks = replace(image.tracks, depth=replace(image.tracks.depth, inverse_depth=wall))
    assert (inconsistency(images) != "") == told


def test_three_pairs_are_needed_and_tracks_that_both_see():
    _, images = keyframes(shuffled=range(5))
    assert inconsistency(images[:3]) == ""
    assert inconsistency(images[:4]) != ""
    for k, image in enumerate(images):
        image.tracks = image.tracks.of(image.tracks.ids % 5 == k)
    assert inconsistency(images) == ""


@pytest.mark.parametrize("graph_depth", [True, False])
def test_an_update_of_a_young_map_tells_that_the_prior_is_none(graph_depth):
    problem, images = keyframes(8, shuffled=range(8))
    points, options = PointMap(), MapperOptions(landmarks=200, graph_depth=graph_depth)
    points.set(np.arange(len(problem.points)), problem.points)
    update = update_map(MapCopy(images[:5], points, options, problem.focal), KeyframeGraph())
    assert update.no_prior is graph_depth
    assert update.committed is not graph_depth
    assert ("correlates" in update.reason) is graph_depth
    assert not update_map(MapCopy(images, points, options, problem.focal), KeyframeGraph()).no_prior  # no longer young
