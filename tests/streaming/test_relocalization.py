"""Keyframes are recognised in other images, and nothing else is."""

import cv2
import numpy as np
import pytest

from factorsfm.streaming.relocalization import Relocalizer
from factorsfm.synthetic import render_shot
from tests.rendered import rendered


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def corners(image: np.ndarray) -> np.ndarray:
    return cv2.goodFeaturesToTrack(image, 200, 0.01, 6)[:, 0].astype(float)


def known() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image, its corners, and their tracks: any numbers, in no order."""
    image = grey(rendered("truck").images[0])
    xy = corners(image)
    return image, xy, 1000 + np.random.default_rng(0).permutation(len(xy))


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
def test_the_same_view_nearer_or_farther(scale):
    image, xy, ids = known()
    relocalizer = Relocalizer()
    relocalizer.remember(0, image, ids, xy)
    matrix = np.array([[scale, 0, 12.0], [0, scale, -7.0]])
    moved = cv2.warpAffine(image, matrix, (320, 180), flags=cv2.INTER_AREA)
    there = corners(moved)
    found, rows = relocalizer.find(moved, there)
    assert len(found) == len(rows) >= 12
    assert len(np.unique(found)) == len(found)
    row_of = {track: row for row, track in enumerate(ids)}
    expected = xy[[row_of[track] for track in found]] * scale + [12.0, -7.0]
    error = np.linalg.norm(there[rows] - expected, axis=1)
    assert np.mean(error < 3.0) > 0.5


def test_the_keyframe_that_shows_most_of_the_view_is_chosen():
    other = grey(render_shot("static", 2, 320, 180, seed=5).images[0])
    image, xy, ids = known()
    relocalizer = Relocalizer()
    relocalizer.remember(0, other, np.arange(len(corners(other))), corners(other))
    relocalizer.remember(0, image, ids, xy)
    found, rows = relocalizer.find(image, xy)
    assert len(found) > 0.7 * len(xy)
    assert np.mean(ids[rows] == found) > 0.95


def test_a_foreign_view_is_not_found():
    image, xy, ids = known()
    relocalizer = Relocalizer()
    relocalizer.remember(0, image, ids, xy)
    other = grey(render_shot("static", 2, 320, 180, seed=5).images[0])
    found, rows = relocalizer.find(other, corners(other))
    assert len(found) == len(rows) < 25  # up to half of the matches of a view may be wrong; all of these are


def test_many_keyframes_are_taken_in_turn():
    noise = np.random.default_rng(1).integers(0, 256, (20, 180, 320), np.uint8)
    image, xy, ids = known()
    relocalizer = Relocalizer()
    for k, picture in enumerate(noise):
        relocalizer.remember(0, picture, np.arange(50) + 100 * k, corners(picture)[:50])
    relocalizer.remember(0, image, ids, xy)
    attempts = [len(relocalizer.find(image, xy)[0]) for _ in range(3)]  # eight keyframes an image
    assert attempts[0] == attempts[1] == 0
    assert attempts[2] > 0.7 * len(xy)
    resumed = Relocalizer(relocalizer.views, relocalizer.next_view)
    assert len(resumed.find(image, xy)[0]) == attempts[2]


@pytest.mark.parametrize("xy", [np.zeros((0, 2)), np.array([[1.0, 1.0], [319.0, 179.0]])])
def test_nothing_to_compare(xy):
    image, good, ids = known()
    assert [len(part) for part in Relocalizer().find(image, good)] == [0, 0]
    relocalizer = Relocalizer()
    relocalizer.remember(0, image, ids, good)
    assert [len(part) for part in relocalizer.find(image, xy)] == [0, 0]
    bare = Relocalizer()
    bare.remember(0, image, np.arange(len(xy)), xy)
    assert [len(part) for part in bare.find(image, good)] == [0, 0]
