"""What a new keyframe does to the map, on synthetic keyframes whose poses and points are known."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import _COVARIANCE_INFLATION, update_map
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.registration import register_image
from factorsfm.support.options import MapperOptions
from factorsfm.support.status import FrameStatus
from tests.estimation_problems import angles_between, image_depth, make_problem, mapped_images, perturbed, tracks_at

OPTIONS = MapperOptions(landmarks=200)


class Recorder(KeyframeGraph):
    """A graph that remembers what it was asked for."""

    window = None

    def update(self, window, iterations, *added):
        self.window, self.iterations = window, iterations
        return super().update(window, iterations, *added)

    @property
    def keyframes(self):
        return self.window.keyframes.tolist()

    @property
    def guided(self):
        depths = self.window.depths
        return [] if depths is None else self.window.keyframes[depths.image].tolist()


def map_of(points, ids=None):
    mapped = PointMap()
    ids = np.arange(len(points)) if ids is None else ids
    mapped.set(ids, points[ids])
    return mapped


def copy_of(problem, images, points, options=OPTIONS):
    return MapCopy([replace(image) for image in images], points.copy(), options, problem.focal)


def handheld(frames=6, *, guided=(), noise_px=0.1, **kwargs):
    """Problem, keyframes near their true poses, and a map near the true points."""
    problem = make_problem("handheld", frames=frames, points=120, parallax=0.1, noise_px=noise_px)
    near = perturbed(problem.truth, angle_rad=0.001, shift=0.003, structure=0.03)
    near.rotation[1], near.translation[1] = problem.truth.rotation[1], problem.truth.translation[1]
    return problem, mapped_images(problem, near, guided=guided, **kwargs), near.points


# --- what takes part --------------------------------------------------------------------------------------------


def test_the_first_keyframe_is_the_world():
    problem, images, _ = handheld(guided=[0], scale=1.3, shift=0.1)
    update = update_map(copy_of(problem, images[:1], map_of(problem.points)), graph := Recorder())
    assert (update.committed, update.reason, update.position) == (True, "the first keyframe", 0)
    assert (len(update.ids), len(update.points), len(update.removed)) == (0, 0, 0)
    assert (update.poses, update.covariances) == ({}, {})
    assert update.affines[0] == pytest.approx((1.3, 0.1), abs=1e-3)
    assert update.depth is images[0].tracks.depth
    assert graph.window is None


def test_a_young_map_is_solved_for_as_a_whole():
    problem, images, points = handheld()
    update = update_map(copy_of(problem, images, map_of(points)), graph := Recorder())
    assert update.committed
    assert graph.keyframes == list(range(6))
    assert not graph.window.constant.any()  # the first one is the world
    assert graph.guided == []
    assert len(graph.window.ids) == len(points)
    assert list(update.poses) == list(update.covariances) == list(range(1, 6))
    np.testing.assert_array_equal(update.ids, np.arange(len(points)))


def long_shot():
    """26 keyframes; each of the first ten sees another number of the points."""
    problem = make_problem("truck", frames=26, points=126, parallax=0.1)
    images = mapped_images(problem, problem.truth)
    for k, image in enumerate(images[:10]):
        seen = len(problem.points) - 5 * k if k < 9 else 10
        image.tracks = image.tracks.of(image.tracks.ids < seen)
    return problem, images


def test_of_a_long_shot_the_newest_keyframes_and_the_constant_ones_that_share_most_take_part():
    problem, images = long_shot()
    assert len(problem.points) > 75
    update = update_map(copy_of(problem, images, map_of(problem.points)), graph := Recorder())
    assert update.committed
    # The tenth shares too few, and of the nine others the last one shares the fewest.
    assert graph.keyframes == list(range(8)) + list(range(10, 26))
    assert graph.window.constant.tolist() == 8 * [True] + 16 * [False]
    assert list(update.poses) == list(update.covariances) == list(range(10, 26))


def test_without_a_constant_keyframe_the_oldest_two_of_the_window_are_constant():
    problem, images = long_shot()
    for image in images[:10]:
        image.tracks = image.tracks.of(image.tracks.ids < 29)
    update = update_map(copy_of(problem, images, map_of(problem.points)), graph := Recorder())
    assert graph.keyframes == list(range(10, 26))
    assert graph.window.constant.tolist() == 2 * [True] + 14 * [False]
    assert list(update.poses) == list(range(12, 26))


def test_a_young_map_takes_more_steps():
    problem, images = long_shot()
    steps = []
    for count in (2, 4, 26):
        update_map(copy_of(problem, images[-count:], map_of(problem.points)), graph := Recorder())
        steps.append(graph.iterations)
    assert steps[0] > steps[1] > steps[2] == OPTIONS.graph_iterations


def test_landmarks_are_what_two_keyframes_see():
    problem, images, points = handheld()
    n = len(points)
    for k, image in enumerate(images):
        ids = np.append(image.tracks.ids[5:], n + k)  # the last one is its own; the first five nobody sees
        image.tracks = tracks_at(k, ids, np.append(image.tracks.xy[5:], [[0.0, 0.0]], 0))
    mapped = map_of(points)
    mapped.set(n + np.arange(6), np.ones((6, 3)))
    update = update_map(copy_of(problem, images, mapped), graph := Recorder())
    assert len(graph.window.ids) == n - 5
    np.testing.assert_array_equal(update.ids, np.arange(5, n))
    assert len(update.removed) == 0


def test_only_the_graph_is_changed():
    problem, images, points = handheld(guided=[0, 3])
    mapped, before = map_of(points[:-20]), deepcopy(images)
    copy = copy_of(problem, images, mapped)
    copy.read_depth(lambda: image_depth(problem, 5, images[5].tracks.ids))
    update = update_map(copy, KeyframeGraph())
    assert update.committed
    np.testing.assert_array_equal(mapped.all()[1], points[:-20])
    for image, old in zip(images, before, strict=True):
        np.testing.assert_array_equal(image.rotation, old.rotation)
        np.testing.assert_array_equal(image.translation, old.translation)
        assert (image.affine, image.tracks.depth is None) == (old.affine, old.tracks.depth is None)


# --- what comes out ---------------------------------------------------------------------------------------------


def position_errors(update, problem):
    """Largest errors of the poses and the median relative error of the points, the unit of length aside."""
    truth = problem.truth
    distance = np.linalg.norm(update.points, axis=1)
    unit = np.median(distance * truth.inverse_distance[update.ids])
    turn = [angles_between(r[None], truth.rotation[k][None])[0] for k, (r, _) in update.poses.items()]
    shift = [np.linalg.norm(t / unit - truth.translation[k]) for k, (_, t) in update.poses.items()]
    relative = np.linalg.norm(update.points / unit - problem.points[update.ids], axis=1)
    return max(turn), max(shift), float(np.median(relative * truth.inverse_distance[update.ids]))


@pytest.mark.parametrize("guided", [(), (0, 2)])
def test_the_map_comes_nearer_to_the_truth(guided):
    problem, images, points = handheld(guided=guided, noise_px=0.0)
    copy = copy_of(problem, images, map_of(points))
    copy.read_depth(lambda: image_depth(problem, 5, images[5].tracks.ids) if guided else None)
    update = update_map(copy, graph := Recorder())
    assert update.committed
    turn, shift, depth = position_errors(update, problem)
    assert turn < 2e-4
    assert shift < 5e-4
    assert depth < 5e-3
    assert list(update.affines) == graph.guided == ([0, 2, 5] if guided else [])
    for scale, offset in update.affines.values():
        assert scale == pytest.approx(1.0, abs=0.1)
        assert offset == pytest.approx(0.0, abs=0.1)


def test_the_noise_is_what_the_residuals_show():
    for noise_px, low, high in ((0.0, 0.25, 1.0), (1.0, 0.8, 2.0), (8.0, 3.0, 3.0)):
        problem, _, _ = handheld(noise_px=noise_px)
        images = mapped_images(problem, problem.truth)
        update_map(copy_of(problem, images, map_of(problem.points)), graph := Recorder())
        assert low <= graph.window.sigma <= high


def test_covariances_are_those_of_the_errors_but_for_their_inflation():
    """Errors of the solved centres in standard deviations, over draws of independent noise.

    Neighbouring tracks of real footage err alike, for which the covariances are inflated; these tracks do not. The
    newest keyframe is left out: after a single step it has the weights of where it started. The weights of the Cauchy
    kernel make covariances of Gaussian noise 1.6 times too large, which is a ratio of 0.78.
    """
    problem, images = long_shot()
    truth, squares = problem.truth, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        noisy = []
        for image in images:
            noise = 0.25 * rng.standard_normal(image.tracks.pixels.shape)
            noisy.append(replace(image, tracks=replace(image.tracks, pixels=image.tracks.pixels + noise)))
        update = update_map(copy_of(problem, noisy, map_of(problem.points)), KeyframeGraph())
        for k, (rotation, translation) in list(update.poses.items())[:-1]:
            error = rotation @ (truth.rotation[k].T @ truth.translation[k] - rotation.T @ translation)
            squares.append(error @ np.linalg.solve(update.covariances[k][3:, 3:], error) / 3.0)
    assert 0.65 < np.sqrt(_COVARIANCE_INFLATION * np.mean(squares)) < 0.8


def test_there_is_room_for_so_many_landmarks():
    problem, _, _ = handheld()
    images = mapped_images(problem, problem.truth)
    known = np.arange(20)
    options = replace(OPTIONS, landmarks=40)
    update = update_map(copy_of(problem, images, map_of(problem.points, known), options), KeyframeGraph())
    assert len(update.ids) == 40
    np.testing.assert_array_equal(update.ids[:20], known)
    new = images[5].tracks.xy[update.ids[20:]]
    # Where the map has nothing yet: over the whole image.
    assert (np.ptp(new, axis=0) > 0.6 * np.ptp(images[5].tracks.xy, axis=0)).all()
    assert (np.histogram2d(*images[5].tracks.xy[update.ids].T, bins=2)[0] > 3).all()


def test_a_map_that_is_nearly_full_is_left_alone():
    problem, _, _ = handheld()
    images = mapped_images(problem, problem.truth)
    known = np.arange(37)
    options = replace(OPTIONS, landmarks=40)
    update = update_map(copy_of(problem, images, map_of(problem.points, known), options), KeyframeGraph())
    np.testing.assert_array_equal(update.ids, known)


def test_a_track_of_one_keyframe_is_no_point_yet():
    problem, _, _ = handheld()
    images = mapped_images(problem, problem.truth)
    for image in images[:5]:
        image.tracks = image.tracks.of(np.arange(len(image.tracks.ids) - 1))
    n = len(problem.points)
    update = update_map(copy_of(problem, images, map_of(problem.points, np.arange(20))), KeyframeGraph())
    np.testing.assert_array_equal(update.ids, np.arange(n - 1))


# --- what does not fit ------------------------------------------------------------------------------------------


def test_an_observation_that_is_elsewhere_takes_no_point_away():
    problem, images, points = handheld()
    images[2].tracks.pixels[[3, 8, 17], 0] += 25
    update = update_map(copy_of(problem, images, map_of(points)), KeyframeGraph())
    assert len(update.removed) == 0  # the other views hold the points


def test_a_track_that_leaves_its_point_takes_it_away():
    problem, images, points = handheld()
    images[5].tracks.pixels[[3, 17], 0] += 25
    update = update_map(copy_of(problem, images, map_of(points)), KeyframeGraph())
    np.testing.assert_array_equal(update.removed, [3, 17])


def test_a_point_that_holds_nowhere_is_removed():
    problem, images, points = handheld()
    rng = np.random.default_rng(0)
    for image in images:
        image.tracks.pixels[4] = [320, 180] + problem.focal * rng.uniform(-0.3, 0.3, 2)  # never the same thing
    mapped = map_of(points)
    update = update_map(copy_of(problem, images, mapped), KeyframeGraph())
    assert update.committed
    np.testing.assert_array_equal(update.removed, [4])
    assert 4 not in update.ids
    assert mapped.contains(np.array([4])).all()
    assert position_errors(update, problem)[2] < 0.02


def test_nothing_is_removed_from_a_sound_map():
    problem, images, points = handheld(noise_px=0.3)
    update = update_map(copy_of(problem, images, map_of(points)), KeyframeGraph())
    assert len(update.removed) == 0


# --- the depth of the keyframe ----------------------------------------------------------------------------------


def test_the_depth_of_the_new_keyframe_is_read_once():
    problem, images, points = handheld()
    calls = []

    def read():
        calls.append(None)
        return image_depth(problem, 5, images[5].tracks.ids, scale=1.2, shift=0.1)

    copy = copy_of(problem, images, map_of(points))
    copy.read_depth(read)
    update = update_map(copy, KeyframeGraph())
    assert len(calls) == 1
    np.testing.assert_array_equal(update.depth.inverse_depth, read().inverse_depth)
    assert list(update.affines) == [5]
    images[5].tracks = replace(images[5].tracks, depth=update.depth)
    calls.clear()
    copy = copy_of(problem, images, map_of(points))
    copy.read_depth(read)
    assert update_map(copy, KeyframeGraph()).depth is update.depth
    assert not calls


def test_an_update_without_a_depth_map():
    problem, images, points = handheld()
    copy = copy_of(problem, images, map_of(points))
    copy.read_depth(lambda: None)
    update = update_map(copy, KeyframeGraph())
    assert update.committed
    assert update.depth is None
    assert update.affines == {}


def test_the_prior_takes_no_part_in_the_graph_where_it_is_switched_off():
    problem, images, points = handheld(guided=[0, 5])
    options = replace(OPTIONS, graph_depth=False)
    update = update_map(copy_of(problem, images, map_of(points), options), graph := Recorder())
    assert update.committed
    assert graph.guided == []
    assert list(update.affines) == []


# --- updates that fail ------------------------------------------------------------------------------------------


def test_too_few_landmarks():
    problem, images, points = handheld()
    images[5].tracks = images[5].tracks.of(np.arange(14))
    update = update_map(copy_of(problem, images, map_of(points)), graph := Recorder())
    assert (update.committed, update.reason) == (False, "14 of 15 needed landmarks in the keyframe")
    assert graph.window is None


def test_no_landmark_at_all():
    problem, images, _ = handheld()
    images[5].tracks = replace(images[5].tracks, ids=images[5].tracks.ids + 1000)
    update = update_map(copy_of(problem, images, PointMap()), KeyframeGraph())
    assert update.reason == "0 of 15 needed landmarks in the keyframe"


def test_an_update_that_is_rolled_back_changes_nothing():
    problem, images, points = handheld(guided=[0])
    graph, untouched = KeyframeGraph(), KeyframeGraph()
    for g in (graph, untouched):
        assert update_map(copy_of(problem, images[:5], map_of(points)), g).committed
    sound = replace(images[5])
    images[5].rotation = np.diag([-1.0, 1.0, -1.0]) @ images[5].rotation
    copy = copy_of(problem, images, map_of(points))
    copy.read_depth(lambda: image_depth(problem, 5, images[5].tracks.ids))
    update = update_map(copy, graph)
    assert not update.committed
    assert "behind the camera" in update.reason or "indeterminate" in update.reason
    assert update.position == 5
    assert update.depth is not None  # it was read, and may serve
    assert (len(update.ids), len(update.removed)) == (0, 0)
    assert (update.poses, update.affines, update.covariances) == ({}, {}, {})
    images[5] = sound
    results = [update_map(copy_of(problem, images, map_of(points)), g) for g in (graph, untouched)]
    np.testing.assert_array_equal(results[0].points, results[1].points)
    np.testing.assert_array_equal(results[0].covariances[5], results[1].covariances[5])


# --- a shot -----------------------------------------------------------------------------------------------------


def run(problem, *, depth=True, noise=0.0, frames=None):
    """The least mapper: the first frame lifted, the others registered, every third one a keyframe."""
    graph, points, options = KeyframeGraph(), PointMap(), OPTIONS
    ids, xy = problem.of_frame(0)
    lifted = image_depth(problem, 0, ids, noise=noise)
    points.set(ids, np.c_[xy, np.ones(len(xy))] / np.maximum(lifted.inverse_depth, 0.05)[:, None])
    keyframes = []
    for k in range(0, problem.frames, 3):
        ids, xy = problem.of_frame(k)
        image = MappedImage(tracks_at(k, ids, xy), FrameStatus.REGISTERED, "", np.eye(3), np.zeros(3))
        if keyframes:
            near = keyframes[-1].pose
            known = points.contains(ids)
            found = register_image(
                points.at(ids[known]), xy[known], *near, focal=problem.focal, sigma=0.25, inlier_px=3.0
            )
            image.rotation, image.translation = found.rotation, found.translation
        copy = MapCopy([replace(i) for i in [*keyframes, image]], points.copy(), options, problem.focal)
        copy.read_depth(lambda k=k, ids=ids: image_depth(problem, k, ids, noise=noise) if depth else None)
        update = update_map(copy, graph)
        assert update.committed, update.reason
        keyframes.append(image)
        image.tracks = replace(image.tracks, depth=update.depth)
        points.set(update.ids, update.points)
        points.remove(update.removed)
        for other in keyframes:
            position = other.tracks.position
            if position in update.poses:
                other.rotation, other.translation = update.poses[position]
            other.affine = update.affines.get(position, other.affine)
    return update


@pytest.mark.parametrize(("depth", "noise"), [(True, 0.0), (True, 0.2), (False, 0.2)])
def test_a_handheld_shot_reaches_the_truth(depth, noise):
    """Even from a start whose depth is wrong: there is enough parallax to do without."""
    problem = make_problem("handheld", frames=25, points=150, parallax=0.15, noise_px=0.05)
    update = run(problem, depth=depth, noise=noise)
    errors = np.array(position_errors(update, problem))
    assert (errors < [3e-4, 5e-4, 2e-3]).all()
    assert (errors > [1e-6, 1e-6, 1e-5]).all()
    assert len(update.ids) == len(problem.points)


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("motion", ["static", "rotation"])
def test_a_camera_that_does_not_move_is_no_problem(motion, depth):
    """Depths and unit of length are as the start and the weak priors say; every update is committed."""
    problem = make_problem(motion, frames=13, points=150, noise_px=0.1)
    turn, shift, _ = position_errors(run(problem, depth=depth, noise=0.1), problem)
    assert 1e-6 < turn < 2e-3
    assert 1e-6 < shift < 2e-3


# --- the map ----------------------------------------------------------------------------------------------------


def test_points_are_removed_and_may_come_back():
    points = map_of(np.arange(12.0).reshape(4, 3) + 1)
    points.remove(np.array([1, 3]))
    np.testing.assert_array_equal(points.contains(np.arange(5)), [True, False, True, False, False])
    np.testing.assert_array_equal(points.all()[0], [0, 2])
    points.set(np.array([3]), np.full((1, 3), 7.0))
    np.testing.assert_array_equal(points.at(np.array([3])), [[7.0, 7.0, 7.0]])


def test_a_copy_of_the_map_is_independent():
    points = map_of(np.ones((4, 3)))
    copy = points.copy()
    copy.remove(np.array([0]))
    copy.set(np.array([1, 5000]), np.zeros((2, 3)))
    np.testing.assert_array_equal(points.all()[0], np.arange(4))
    np.testing.assert_array_equal(points.all()[1], 1.0)
    np.testing.assert_array_equal(copy.all()[0], [1, 2, 3, 5000])
