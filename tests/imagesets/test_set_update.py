"""The graph under the mapper of image sets: its window, what it solves, and when all images are adjusted instead."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from factorsfm import Options
from factorsfm.camera.projection import with_focal
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.imagesets.set_update import update_set
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.mapped_images import MappedImage
from tests.imagesets.test_image_set import FOCAL, Ring

FREE = 6  # images that an update solves for


def solved(cameras: int = 11, **kwargs: float) -> SetMapper:
    mapper = SetMapper(Ring(cameras, points=900).tracks(**kwargs), FOCAL, Options().for_image_sets())
    mapper.run()
    assert all(image.registered for image in mapper.images)
    return mapper


def shared_with_newest(mapper: SetMapper) -> np.ndarray:
    position = np.array([image.tracks.position for image in mapper._order])
    return mapper._common[position[-1], position]


def updated(mapper: SetMapper, held: np.ndarray, iterations: int = 4) -> tuple[MapUpdate, float]:
    options = replace(mapper.options, graph_iterations=iterations)
    copy = MapCopy(mapper._order, mapper.points, options, mapper.focal)
    return update_set(copy, KeyframeGraph(), shared_with_newest(mapper), held)


def move(image: MappedImage, angle: float, shift: float) -> None:
    turn = cv2.Rodrigues(np.array([angle, -angle, angle]))[0]
    image.rotation, image.translation = turn @ image.pose[0], turn @ image.pose[1] + [shift, -shift, shift]


def off(pose: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> float:
    return float(np.abs(np.column_stack(pose) - np.column_stack(truth)).max())


def test_the_newest_image_and_those_that_share_most_with_it_are_solved_for() -> None:
    mapper = solved(14, noise_px=0.0)
    truth = {image.tracks.position: image.pose for image in mapper._order}
    shared = shared_with_newest(mapper)
    shared[0], newest = 0, len(shared) - 1
    around = [k for k in np.argsort(-shared, kind="stable") if k != newest and shared[k] >= 30][: FREE - 1]
    for k in (newest, *around):
        move(mapper._order[k], 0.002, 0.005)
    update, error = updated(mapper, np.zeros(newest + 1, bool))
    assert set(update.poses) == {mapper._order[k].tracks.position for k in (newest, *around)}
    assert len(update.poses) == FREE
    assert max(off(pose, truth[position]) for position, pose in update.poses.items()) < 1e-6
    assert error < 1e-3
    np.testing.assert_allclose(update.points, mapper.points.at(update.ids), atol=1e-5)
    assert len(update.ids) == 300  # the others wait for the adjustment of all images


def test_all_images_of_a_small_map_are_solved_for_but_the_world() -> None:
    mapper = solved(FREE, noise_px=0.0)
    world = mapper._order[0].tracks.position
    truth = mapper._order[-1].pose
    move(mapper._order[-1], 0.002, 0.005)
    update, error = updated(mapper, np.zeros(FREE, bool), iterations=6)
    assert set(update.poses) == set(range(FREE)) - {world}
    assert error < 1e-3
    assert np.abs(update.poses[mapper._order[-1].tracks.position][0] - truth[0]).max() < 1e-6
    assert 400 < len(update.ids) < 550  # those beside the 300 of the graph, too


def test_poses_that_are_given_do_not_move() -> None:
    mapper = solved(noise_px=0.0)
    newest = mapper._order[-1]
    truth = newest.pose
    move(newest, 0.002, 0.005)
    update, _ = updated(mapper, np.arange(len(mapper._order)) < len(mapper._order) - 1)
    assert set(update.poses) == {newest.tracks.position}
    assert off(update.poses[newest.tracks.position], truth) < 1e-6


def test_an_image_without_landmarks_is_no_update() -> None:
    mapper = solved(5, noise_px=0.0)
    mapper.points.remove(mapper._order[-1].tracks.ids[12:])
    update, error = updated(mapper, np.zeros(5, bool))
    assert not update.committed
    assert update.reason == "9 of 15 needed landmarks in the image"
    assert error == np.inf


def test_what_does_not_fit_is_left_to_the_adjustment_of_all_images() -> None:
    mapper = solved()
    move(mapper._order[-1], 0.5, 1.0)
    before = [image.pose for image in mapper._order], mapper.points.copy()
    mapper._update()
    assert not mapper._is_settled()
    assert all(off(image.pose, pose) == 0.0 for image, pose in zip(mapper._order, before[0], strict=True))
    np.testing.assert_array_equal(mapper.points.table, before[1].table)
    mapper._adjusted -= 2
    mapper._take_in(None)
    assert mapper._is_settled()


class Counting(SetMapper):
    """Takes note of the number of images at each adjustment and update."""

    def _adjust(self) -> None:
        self.adjusted = [*getattr(self, "adjusted", []), len(self._order)]
        super()._adjust()

    def _update(self) -> None:
        self.updated = [*getattr(self, "updated", []), len(self._order)]
        super()._update()


def test_a_map_that_fits_is_adjusted_as_a_whole_only_when_it_has_doubled() -> None:
    mapper = Counting(Ring(14).tracks(wrong=0.05), FOCAL, Options().for_image_sets())
    mapper.run()
    assert mapper.adjusted == [2, 4, 8, 14, 14]  # at last on all tracks
    assert mapper.updated == [3, 5, 6, 7, 9, 10, 11, 12, 13, 14]


def test_a_focal_length_that_is_open_is_refined_until_it_changes_little() -> None:
    guess = 1.2 * FOCAL
    tracks = [replace(t, camera=with_focal(t.camera, guess)) for t in Ring(10).tracks()]
    mapper = Counting(tracks, guess, Options(lens="focal").for_image_sets())
    mapper.run()
    assert mapper.focal == pytest.approx(FOCAL, rel=1e-3)
    assert mapper.adjusted == [2, 3, 4, 5, 10, 10]  # with four images it is refined first
    assert mapper.updated == [3, 6, 7, 8, 9]
