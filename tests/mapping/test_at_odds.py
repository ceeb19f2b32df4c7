"""How much of an image is at odds with the map: a body that moves by itself, beside mapped and unmapped scene."""

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping.at_odds import became_much, share_at_odds
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.point_map import PointMap
from factorsfm.motion.neighbours import share_of_image
from factorsfm.support.options import MapperOptions
from tests.estimation_problems import make_problem, mapped_images

OPTIONS = MapperOptions()


def body_and_scene(frames=8, *, speed_px, noise_px=0.1):
    """Keyframes with true poses and a map of every second point of the scene; what moves is on the left third."""
    problem = make_problem("truck", frames=frames, points=300, parallax=0.1, noise_px=noise_px)
    images = mapped_images(problem, problem.truth)
    first = images[0].tracks
    left = first.ids[first.pixels[:, 0] < np.quantile(first.pixels[:, 0], 1 / 3)]
    for k, image in enumerate(images):
        moves = np.isin(image.tracks.ids, left)
        image.tracks.xy[moves, 1] += speed_px * np.sin(k) / problem.focal
    scene = np.setdiff1d(np.arange(len(problem.points)), left)
    points = PointMap()
    points.set(scene[::2], problem.points[scene[::2]])
    return problem, images, points, left


def test_what_moves_is_at_odds_and_what_is_not_mapped_yet_is_not():
    problem, images, points, left = body_and_scene(speed_px=8.0)
    newest = images[-1].tracks
    size = newest.camera.width, newest.camera.height
    true_share = share_of_image(newest.pixels, np.isin(newest.ids, left), size)
    found = share_at_odds(images, points, problem.focal, OPTIONS)
    assert 0.15 < true_share < 0.5
    assert found == pytest.approx(true_share, abs=0.03)


@pytest.mark.parametrize("noise_px", [0.0, 0.25])
def test_a_scene_at_rest_is_not(noise_px):
    problem, images, points, _ = body_and_scene(speed_px=0.0, noise_px=noise_px)
    assert share_at_odds(images, points, problem.focal, OPTIONS) < 0.02


def test_where_all_is_mapped_or_nothing_there_is_nothing_to_ask():
    problem, images, points, _ = body_and_scene(speed_px=8.0)
    assert share_at_odds(images, PointMap(), problem.focal, OPTIONS) == 0.0
    points.set(np.arange(len(problem.points)), problem.points)
    assert share_at_odds(images, points, problem.focal, OPTIONS) == 0.0


@pytest.mark.parametrize("asks", [True, False])
def test_the_graph_answers_where_it_is_asked(asks):
    problem, images, points, _ = body_and_scene(5, speed_px=8.0)
    update = update_map(MapCopy(images, points, OPTIONS, problem.focal, asks_odds=asks), KeyframeGraph())
    assert update.committed
    assert (update.at_odds is not None) == asks
    if update.at_odds is not None:
        assert 0.15 < update.at_odds < 0.5


def test_it_is_said_once():
    assert became_much(0.0, 0.31).startswith("31% of the image is at odds with the map")
    assert became_much(0.31, 0.4) == ""
    assert became_much(0.0, 0.24) == ""
