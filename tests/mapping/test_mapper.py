"""Images that the map loses, on synthetic tracks whose cameras are known."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.graph.process import GraphProcess
from factorsfm.mapping.keyframes import is_keyframe, update_delay
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus
from tests.estimation_problems import angles_between, make_problem, tracks_at


def lost_at_both_ends(problem, known, life):
    """A mapper that holds some images and the tracks of their first, each track seen for so many images."""
    mapper = Mapper(GraphProcess(), problem.focal, 640, Options.preset_named("geometry"), has_prior=False)
    born = np.arange(len(problem.points)) % (problem.frames + life) - life + 1
    for k in range(problem.frames):
        ids, xy = problem.of_frame(k)
        alive = (born[ids] <= k) & (k < born[ids] + life)
        tracks = tracks_at(k, ids[alive], xy[alive])
        image = MappedImage(tracks, FrameStatus.LOST, "0 of 15 needed tracks have a point in the map")
        if k in known:
            image.status = FrameStatus.REGISTERED
            image.rotation, image.translation = problem.truth.rotation[k], problem.truth.translation[k]
            image.inliers, image.threshold, image.keyframe = len(tracks.ids), 3.0, True
            mapper.keyframes.append(k)
        mapper.images.append(image)
    ids = mapper.images[known[0]].tracks.ids
    mapper.points.set(ids, problem.points[ids])
    mapper.started = True
    return mapper


@pytest.mark.parametrize(
    ("noise_px", "moved", "turned"), [(0.0, (0.0, 1e-11), (0.0, 3e-12)), (0.1, (0.004, 0.02), (5e-4, 3e-3))]
)
def test_images_before_and_after_the_map_are_taken_up_at_the_end(noise_px, moved, turned):
    problem = make_problem("truck", frames=30, points=200, parallax=0.3, noise_px=noise_px)
    mapper = lost_at_both_ends(problem, range(10, 20), life=9)
    mapper.finish()
    assert all(image.registered for image in mapper.images)
    rotation = np.array([image.rotation for image in mapper.images])
    center = np.array([-image.rotation.T @ image.translation for image in mapper.images])
    true_center = -np.einsum("kji,kj->ki", problem.truth.rotation, problem.truth.translation)
    error = np.linalg.norm(center - true_center, axis=1) / np.linalg.norm(true_center[-1] - true_center[0])
    np.testing.assert_array_equal(error[10:20], 0.0)
    assert moved[0] < error.max() < moved[1]
    assert turned[0] < angles_between(rotation, problem.truth.rotation).max() < turned[1]


def test_images_that_share_no_track_with_the_map_stay_lost_and_say_why():
    problem = make_problem("truck", frames=12, points=200, parallax=0.3)
    mapper = lost_at_both_ends(problem, range(6), life=12)
    for image in mapper.images[9:]:
        image.tracks = replace(image.tracks, ids=image.tracks.ids + 1000)
        image.message = "something else"
    mapper.finish()
    assert [image.registered for image in mapper.images] == 9 * [True] + 3 * [False]
    assert {(image.status, image.message) for image in mapper.images[9:]} == {(FrameStatus.LOST, "something else")}


def test_a_lost_image_is_registered_on_tracks_that_no_keyframe_saw():
    problem = make_problem("truck", frames=12, points=200, parallax=0.3)
    mapper = lost_at_both_ends(problem, range(10), life=9)
    mapper.images, newest = mapper.images[:10], mapper.images[10]
    image = mapper.add(newest.tracks, lambda: None)
    mapper.close()
    assert image.status is FrameStatus.REGISTERED
    np.testing.assert_allclose(image.translation, problem.truth.translation[10], rtol=0.0, atol=1e-12)


def test_rotations_stay_rotations_however_long_the_shot():
    problem = make_problem("truck", frames=160, points=300, parallax=0.9)
    mapper = Mapper(GraphProcess(), problem.focal, 640, Options.preset_named("geometry"), has_prior=False)
    for k in range(problem.frames):
        mapper.add(tracks_at(k, *problem.of_frame(k)), lambda: None)
    mapper.close()
    assert len(mapper.keyframes) > 20
    rotation = np.array([image.rotation for image in mapper.images])
    product = rotation @ rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)


@pytest.mark.parametrize(("rate", "interval", "delay"), [(12.0, 6, 2), (24.0, 12, 5), (60.0, 30, 12)])
def test_keyframes_come_after_a_time_and_not_after_a_number_of_frames(rate, interval, delay):
    """Of a camera that hardly moves; the graph has the same time for each of them."""
    problem = make_problem("truck", frames=interval + 2, points=200, parallax=0.001, noise_px=0.1)
    images = [tracks_at(k, *problem.of_frame(k)) for k in range(problem.frames)]
    options = Options().mapper
    width = round(2 * problem.focal)
    wanted = [
        is_keyframe(image, images[0], 19, problem.focal, width, options, rate=rate, rough=False) for image in images[1:]
    ]
    assert wanted.index(True) + 1 == interval
    assert update_delay(19, options, rate) == delay
