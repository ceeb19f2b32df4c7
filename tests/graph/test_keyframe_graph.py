"""iSAM2 over keyframes: the truth, the minimum and covariances of other solvers, and updates that are all or nothing.

`Shot` is the least mapper there can be: it hands window after window to the graph and keeps what comes back.
"""

import re
from collections import Counter
from dataclasses import fields, replace

import gtsam
import gtsam_unstable
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, L, T, X

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.graph import live_isam
from factorsfm.graph.factors import camera_from_pose
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.live_isam import YOUNG, LiveIsam
from factorsfm.graph.window import DepthMeasurements, Window
from factorsfm.priors.affine import SCALE_SIGMA, SHIFT_SIGMA
from factorsfm.support.options import MapperOptions, PolishOptions
from tests.estimation_problems import angles_between, in_unit_of, make_problem, mapped_images, perturbed

FRAMES = 6
SIGMA = 0.25  # pixels
DEPTH_SIGMA = 0.05
EXACT = PolishOptions(tolerance=1e-12, point_sigma=100.0)
KINDS = {
    gtsam.GenericProjectionFactorCal3_S2: "projection",
    gtsam.TriangulationFactorPoseCal3_S2: "constant",
    gtsam_unstable.ProjectionFactorPPPCCal3_S2: "depth",
    gtsam.PriorFactorPose3: "pose",
    gtsam.PriorFactorPoint3: "landmark",
    gtsam.PriorFactorCal3_S2: "affine",
    gtsam.RangeFactorPose3: "size",
}


class Shot:
    """Keyframes of a synthetic shot, with a first guess away from the truth."""

    def __init__(self, motion="handheld", *, frames=FRAMES, noise_px=0.0, guided=None, affine=(1.0, 0.0), seed=0):
        self.problem = make_problem(motion, frames=frames, points=80, parallax=0.1, noise_px=noise_px, seed=seed)
        guess = perturbed(self.problem.truth, seed, angle_rad=0.002, shift=0.005, structure=0.05)
        guided = range(frames) if guided is None else guided
        self.images = mapped_images(self.problem, guess, guided=guided, scale=affine[0], shift=affine[1])
        self.points = guess.points
        self.half = len(self.points) // 2  # known from the first keyframe on; the rest appears in the third
        self.graph = KeyframeGraph()
        self.solved = None

    def window(self, frames, *, constant=0, ids=None):
        """Some keyframes, the first ones of them constant, and the landmarks."""
        images = [self.images[k] for k in frames]
        if ids is None:
            ids = np.arange(len(self.points) if max(frames) >= 2 else self.half)
        o = gather([image.tracks for image in images], ids, self.problem.focal)
        return Window(
            keyframes=np.array(list(frames)),
            constant=np.arange(len(images)) < constant,
            rotation=np.array([image.rotation for image in images]),
            translation=np.array([image.translation for image in images]),
            ids=ids,
            points=self.points[ids],
            frame=o.frame,
            point=o.point,
            pixels=o.pixels,
            focal=self.problem.focal,
            sigma=SIGMA,
            depths=self._depths(images, ids),
        )

    def _depths(self, images, ids):
        guided = np.array([row for row, image in enumerate(images) if image.tracks.depth is not None], np.int64)
        if not len(guided):
            return None
        scale, shift = np.array([images[row].affine or (1.0, 0.0) for row in guided]).T
        row, point, value = [], [], []
        for k, image in enumerate(images[g] for g in guided):
            seen = np.isin(image.tracks.ids, ids)
            point.append(np.searchsorted(ids, image.tracks.ids[seen]))
            value.append(image.tracks.depth.inverse_depth[seen])
            row.append(np.full(len(point[-1]), k))
        row, point, value = map(np.concatenate, (row, point, value))
        return DepthMeasurements(
            guided, scale, shift, row, point, value, np.full(len(row), DEPTH_SIGMA), SCALE_SIGMA, SHIFT_SIGMA
        )

    def update(self, frames, *, iterations=15, **kwargs):
        """One update of the graph, kept if it is committed."""
        result = self.graph.update(self.window(frames, **kwargs), iterations)
        if result.committed:
            self.solved = solved = result.window
            for row, k in enumerate(frames):
                self.images[k].rotation, self.images[k].translation = solved.rotation[row], solved.translation[row]
            if (d := solved.depths) is not None:
                for row, *affine in zip(d.image, d.scale, d.shift, strict=True):
                    self.images[frames[row]].affine = tuple(affine)
            self.points[solved.ids] = solved.points
        return result

    def run(self, frames=None, **kwargs):
        for k in range(1, frames or len(self.images)):
            result = self.update(range(k + 1), **kwargs)
            assert result.committed, result.reason
        return self

    @property
    def isam(self):
        return self.graph._live._isam

    def variables(self):
        """Of poses, affines and the constant of these; those of the landmarks are counted apart."""
        keys = self.isam.getLinearizationPoint().keys()
        return {key for key in keys if gtsam.symbolChr(key) != ord("l")}

    def landmarks(self):
        keys = self.isam.getLinearizationPoint().keys()
        return {gtsam.symbolIndex(key) for key in keys if gtsam.symbolChr(key) == ord("l")}

    def factors(self):
        graph = self.isam.getFactorsUnsafe()
        return [graph.at(k) for k in range(graph.size()) if graph.exists(k)]

    def count(self):
        """Number of factors of each kind."""
        return Counter(KINDS[type(factor)] for factor in self.factors())


def state_of(window):
    distance = np.linalg.norm(window.points, axis=1)
    bearing, focal = window.points / distance[:, None], np.log([window.focal])
    return State(window.rotation, window.translation, bearing, 1.0 / distance, focal)


def errors(shot):
    """Largest error of a rotation (radians) and of a translation, median relative error of the points."""
    truth, state = shot.problem.truth, in_unit_of(state_of(shot.solved), shot.problem.truth)
    at = shot.solved.keyframes
    depth = np.linalg.norm(state.points - shot.problem.points, axis=1) * truth.inverse_distance
    shift = np.linalg.norm(state.translation - truth.translation[at], axis=1)
    return np.array([angles_between(state.rotation, truth.rotation[at]).max(), shift.max(), np.median(depth)])


def unit(shot):
    """Inverse distances in units of the true ones."""
    return np.median(1.0 / np.linalg.norm(shot.solved.points, axis=1) / shot.problem.truth.inverse_distance)


def assert_same(window, other, tolerance):
    for name in ("rotation", "translation", "points"):
        np.testing.assert_allclose(getattr(window, name), getattr(other, name), rtol=0, atol=tolerance, err_msg=name)


def assert_equal(window, other):
    for field in fields(Window):
        a, b = getattr(window, field.name), getattr(other, field.name)
        if field.name != "depths":
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    for field in fields(DepthMeasurements) if other.depths is not None else ():
        a, b = getattr(window.depths, field.name), getattr(other.depths, field.name)
        np.testing.assert_array_equal(a, b, err_msg=field.name)


# --- convergence ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guided", [(), range(FRAMES)])
@pytest.mark.parametrize("motion", ["truck", "handheld", "dolly"])
def test_exact_observations_lead_to_the_truth(motion, guided):
    """The model error of the native depth factors, 1e-4 of the lateral position, moves hardly anything."""
    shot = Shot(motion, guided=guided).run()
    assert (errors(shot) < ([2e-6, 2e-6, 3e-5] if guided else [1e-7, 1e-7, 1e-6])).all()
    if guided:
        np.testing.assert_allclose(shot.solved.depths.scale * unit(shot), 1.0, atol=1e-3)
        np.testing.assert_allclose(shot.solved.depths.shift, 0.0, atol=1e-3)


def test_the_steps_of_the_mapper_are_enough():
    """Every update goes on from the one before; the first ones have further to go."""
    shot = Shot("handheld")
    for k in range(1, FRAMES):
        steps = max(MapperOptions().graph_iterations, 8 // (k + 1))
        assert shot.update(range(k + 1), iterations=steps).committed
    assert (errors(shot) < [2e-5, 2e-5, 2e-5]).all()  # one step a keyframe leaves a little for the next


@pytest.mark.parametrize("motion", ["truck", "handheld"])
def test_scale_and_shift_of_the_prior_are_found(motion):
    """As far as they are not believed to be 1 and 0; the unit of length may follow the scale."""
    shot = Shot(motion, affine=(1.3, 0.15)).run()
    assert (errors(shot) < [6e-4, 6e-4, 2e-3]).all()
    np.testing.assert_allclose(shot.solved.depths.scale * unit(shot), 1.3, atol=0.02)
    np.testing.assert_allclose(shot.solved.depths.shift, 0.15, atol=0.03)


def test_noise_costs_what_it_should():
    found = np.array([errors(Shot("truck", noise_px=SIGMA, seed=seed).run()) for seed in range(2)])
    assert (found < [4e-3, 4e-3, 0.015]).all()
    assert (found > [1e-4, 1e-4, 1e-3]).all()


def test_outliers_are_tolerated():
    shot = Shot("truck")
    for image in shot.images:
        image.tracks.pixels[image.tracks.position :: 23] += 12.0
    found = errors(shot.run())
    assert (found < [1e-4, 5e-4, 1e-2]).all()
    assert (found > 1e-8).all()


def test_a_prior_that_comes_later():
    shot = Shot("truck", guided=(3, 5)).run(3)
    assert shot.variables() == {X(0), X(1), X(2)}
    for k in range(3, FRAMES):
        assert shot.update(range(k + 1)).committed
    assert shot.variables() == {X(k) for k in range(FRAMES)} | {A(3), A(5), T(0)}
    assert (errors(shot) < [5e-6, 5e-6, 1e-4]).all()


def test_constant_keyframes_stay_to_the_bit():
    shot = Shot("handheld", noise_px=0.1).run(4)
    before = shot.window(range(5), constant=3)
    result = shot.update(range(5), constant=3)
    assert list(result.covariance) == [3, 4]
    np.testing.assert_array_equal(shot.solved.rotation[:3], before.rotation[:3])
    np.testing.assert_array_equal(shot.solved.translation[:3], before.translation[:3])
    assert (np.abs(shot.solved.translation[3:] - before.translation[3:]).max(1) > 1e-6).all()
    assert shot.variables() == {X(3), X(4), A(3), A(4), T(0)}


def test_the_world_stays_where_it_is():
    shot = Shot("handheld", frames=12, noise_px=SIGMA).run(iterations=2)
    np.testing.assert_allclose(shot.solved.rotation[0], np.eye(3), atol=1e-7)
    np.testing.assert_allclose(shot.solved.translation[0], 0.0, atol=1e-7)


def test_an_old_map_keeps_its_unit_of_length():
    shot = Shot("handheld", frames=12, noise_px=SIGMA, affine=(1.2, 0.0)).run(YOUNG)
    assert "size" not in shot.count()
    for k in range(YOUNG, 12):
        assert shot.update(range(k + 1), iterations=2).committed
        assert shot.count()["size"] == 1
        length = np.linalg.norm(shot.images[YOUNG - 1].translation)
        if k == YOUNG:
            first = length
    assert length == pytest.approx(first, rel=1e-3)


# --- beside other solvers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("constant", [0, 2])
@pytest.mark.parametrize("guided", [(), range(FRAMES)])
def test_the_result_is_the_minimum_of_its_factors(guided, constant):
    shot = Shot("handheld", noise_px=SIGMA, guided=guided).run(FRAMES - 1)
    assert shot.update(range(FRAMES), constant=constant, iterations=25).committed
    graph = gtsam.NonlinearFactorGraph()
    for factor in shot.factors():
        graph.add(factor)
    found = shot.isam.calculateEstimate()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    minimum = gtsam.LevenbergMarquardtOptimizer(graph, found, parameters).optimize()
    assert graph.error(found) == pytest.approx(graph.error(minimum), rel=1e-9)
    for row in range(constant, FRAMES):
        rotation, translation = camera_from_pose(minimum.atPose3(X(row)))
        np.testing.assert_allclose(shot.solved.rotation[row], rotation, atol=1e-6)
        np.testing.assert_allclose(shot.solved.translation[row], translation, atol=1e-6)
    points = np.array([minimum.atPoint3(L(j)) for j in shot.solved.ids])
    np.testing.assert_allclose(shot.solved.points, points, atol=1e-5)


def batch_problem(window):
    """The same problem without the prior for the batch solver."""
    observations = Observations(window.frame, window.point, window.pixels)
    return BundleAdjustment(
        state_of(window), observations, EXACT, ErrorModel(window.sigma), free=Free(held=window.constant)
    )


@pytest.mark.parametrize("frames", [FRAMES, 12])
def test_the_minimum_is_that_of_the_batch_solver(frames):
    """Two constant cameras hold the unit of length, which the priors of the two hold at different places."""
    shot = Shot("handheld", frames=frames, noise_px=SIGMA, guided=()).run(frames - 1)
    batch = batch_problem(shot.window(range(frames), constant=2))
    batch.solve(50)
    assert shot.update(range(frames), constant=2, iterations=25).committed
    np.testing.assert_allclose(shot.solved.rotation, batch.state.rotation, atol=1e-6)
    np.testing.assert_allclose(shot.solved.translation, batch.state.translation, atol=1e-6)
    np.testing.assert_allclose(shot.solved.points, batch.state.points, atol=1e-5)


def assert_covariances(result, expected, tolerance):
    for position, covariance in result.covariance.items():
        camera = expected[6 * position : 6 * position + 6, 6 * position : 6 * position + 6]
        sigma = np.sqrt(np.diag(camera))
        np.testing.assert_allclose(covariance / np.outer(sigma, sigma), camera / np.outer(sigma, sigma), atol=tolerance)


def test_covariances_are_those_of_the_batch_solver():
    shot = Shot("handheld", noise_px=SIGMA, guided=())
    result = shot.update(range(FRAMES), constant=2, iterations=25)
    assert list(result.covariance) == list(range(2, FRAMES))
    assert_covariances(result, batch_problem(result.window).marginals().camera, 2e-3)


def test_the_steps_of_the_mapper_give_covariances_on_the_safe_side():
    """One step: weights and derivatives are those of the start, which is as far away as a registration is."""
    shot = Shot("handheld", frames=10, noise_px=SIGMA, guided=())
    near = perturbed(shot.problem.truth, angle_rad=2e-4, shift=4e-4)
    for k in range(1, 10):
        shot.images[k].rotation, shot.images[k].translation = near.rotation[k], near.translation[k]
        result = shot.update(range(k + 1), constant=min(2, k), iterations=max(1, 8 // (k + 1)))
        assert result.committed
    said = np.concatenate([np.diag(covariance) for covariance in result.covariance.values()])
    exact = np.diag(batch_problem(result.window).marginals().camera)[12:60]
    ratio = np.sqrt(said / exact).reshape(-1, 6)
    np.testing.assert_allclose(ratio[:-1], 1.0, atol=0.02)
    assert 1.1 < ratio[-1].min() <= ratio[-1].max() < 1.6


# --- variables and factors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("constant", [0, 2])
def test_every_observation_is_a_factor(constant):
    shot = Shot("handheld", guided=(0, 2, 5)).run(FRAMES - 1)
    window = shot.window(range(FRAMES), constant=constant)
    assert shot.update(range(FRAMES), constant=constant).committed
    count, fixed = shot.count(), int(window.constant[window.frame].sum())
    guided = [k for k in (0, 2, 5) if k >= constant]
    assert shot.variables() == {X(k) for k in range(constant, FRAMES)} | {A(k) for k in guided} | {T(0)}
    assert shot.landmarks() == set(window.ids.tolist())
    assert count["projection"] == len(window.frame) - fixed
    assert count["constant"] == fixed
    assert (fixed > 0) == (constant > 0)
    assert count["landmark"] == len(window.ids)
    assert count["affine"] == len(guided)
    assert count["pose"] == FRAMES - constant + 1  # and the constant of the depth factors


def depth_factors(shot):
    """Keyframes and tracks of the depth factors."""
    keys = [factor.keys() for factor in shot.factors() if KINDS[type(factor)] == "depth"]
    return np.array([(gtsam.symbolIndex(key[0]), gtsam.symbolIndex(key[2])) for key in keys]).reshape(-1, 2)


@pytest.mark.parametrize("most", [100, 10])
def test_every_landmark_has_a_depth_and_every_keyframe_some(most, monkeypatch):
    monkeypatch.setattr(live_isam, "_DEPTHS", most)
    shot = Shot("handheld", frames=5).run()
    keyframe, track = depth_factors(shot).T
    assert set(track) == set(range(len(shot.points)))
    assert len(set(zip(keyframe, track, strict=True))) == len(track)
    assert (np.bincount(keyframe, minlength=5) >= min(most, shot.half)).all()
    assert len(track) <= len(shot.points) + 5 * most


def test_landmarks_that_lose_their_only_depth_get_another(monkeypatch):
    monkeypatch.setattr(live_isam, "_DEPTHS", 10)
    shot = Shot("handheld", frames=12)
    for k in range(1, 12):
        assert shot.update(range(max(0, k - 6), k + 1), constant=2 if k > 6 else 0).committed
    assert set(depth_factors(shot)[:, 1]) == set(range(len(shot.points)))


def test_keyframes_that_leave_the_window_leave_the_graph():
    shot = Shot("handheld", guided=(0, 2, 5)).run(4)
    assert shot.variables() == {X(0), X(1), X(2), X(3), A(0), A(2), T(0)}
    assert shot.update(range(1, 5), constant=1).committed
    assert shot.variables() == {X(2), X(3), X(4), A(2), T(0)}
    assert shot.update(range(1, 6), constant=2).committed
    assert shot.variables() == {X(3), X(4), X(5), A(5), T(0)}
    assert shot.update([0, 2, 4, 5], constant=2).committed
    assert shot.variables() == {X(4), X(5), A(5), T(0)}
    for factor in shot.factors():
        keys = factor.keys()
        assert {key for key in keys if gtsam.symbolChr(key) != ord("l")} <= shot.variables()


def test_a_constant_keyframe_may_be_solved_for_again():
    """In sets of images the window is no longer one of time: keyframes come back, in any order."""
    shot = Shot("handheld").run(4)
    n = len(shot.points)
    for frames in ([0, 1, 2, 3, 4], [3, 4, 0, 1, 2, 5], [0, 2, 1, 3, 4, 5]):
        assert shot.update(frames, constant=2).committed
        assert {X(k) for k in frames[2:]} == {key for key in shot.variables() if gtsam.symbolChr(key) == ord("x")}
        assert shot.count()["projection"] == n * len(frames[2:])
        assert shot.count()["constant"] == n * 2
    assert shot.update(range(FRAMES)).committed
    assert (errors(shot) < [2e-6, 2e-6, 3e-5]).all()


def test_landmarks_that_leave_the_window_leave_the_graph():
    shot = Shot("handheld").run(4)
    n, few = len(shot.points), np.arange(10, 30)
    assert shot.update(range(5), constant=2).committed
    assert shot.landmarks() == set(range(n))
    assert shot.update(range(5), constant=2, ids=few).committed
    assert shot.landmarks() == set(few.tolist())
    assert shot.count()["projection"] == 3 * len(few)
    assert shot.count()["constant"] == 2 * len(few)
    assert set(depth_factors(shot)[:, 1]) <= set(few.tolist())
    assert shot.update(range(FRAMES), constant=2).committed  # and may come back
    assert shot.landmarks() == set(range(n))
    assert shot.count()["projection"] == (FRAMES - 2) * n
    assert (errors(shot) < [2e-6, 2e-6, 3e-5]).all()


def test_a_moving_window_costs_the_same_however_long_the_shot():
    """Slots of factors are used again."""
    shot = Shot("handheld", frames=48)
    slots, counts = [], []
    for k in range(7, 48):
        ids = np.sort((np.arange(30) + 3 * k) % len(shot.points))  # some landmarks go, some come back
        assert shot.update(range(k - 7, k + 1), constant=2, ids=ids, iterations=3).committed
        slots.append(shot.isam.getFactorsUnsafe().size())
        counts.append(shot.count())
    assert all(count == counts[8] for count in counts[8:])
    assert counts[8]["projection"] == 6 * 30
    assert counts[8]["constant"] == 2 * 30
    assert all(count == slots[1] for count in slots[1:])
    assert slots[1] < 1.5 * counts[8].total()


def test_a_moving_window_leads_to_the_truth():
    shot = Shot("handheld").run(3)
    for k in range(3, FRAMES):
        assert shot.update(range(k - 2, k + 1), constant=2).committed
    assert shot.update(range(FRAMES)).committed
    assert (errors(shot) < [2e-6, 2e-6, 3e-5]).all()


def test_another_focal_length_begins_a_new_graph():
    shot = Shot("handheld", noise_px=0.1).run(4)
    assert shot.update(range(5), constant=2).committed
    window = shot.window(range(FRAMES), constant=2)
    other = replace(window, focal=1.01 * window.focal, pixels=1.01 * window.pixels)
    results = [graph.update(other, 10) for graph in (shot.graph, KeyframeGraph())]
    assert_equal(results[0].window, results[1].window)


# --- transactions -----------------------------------------------------------------------------------------------


def turned_away(image):
    image.rotation = np.diag([-1.0, 1.0, -1.0]) @ image.rotation


def wrong_tracks(image):
    pixels = np.random.default_rng(0).permutation(image.tracks.pixels)
    image.tracks = replace(image.tracks, pixels=pixels, depth=None)


def no_observations(image):
    image.tracks = replace(image.tracks.of(np.arange(0)), depth=None)


def not_finite(image):
    image.translation = np.full(3, np.nan)


def mirrored_depth(image):
    depth = image.tracks.depth
    image.tracks = replace(image.tracks, depth=replace(depth, inverse_depth=3.0 - depth.inverse_depth))


BAD = [
    (turned_away, "landmarks lie behind the camera|indeterminate"),
    (wrong_tracks, r"the median reprojection error is [\d.]+ pixels, at most 10 expected|behind the camera"),
    (no_observations, "the keyframe observes no landmark"),
    (not_finite, "indeterminate|not finite"),
    (mirrored_depth, "the depth is mirrored"),
]


@pytest.mark.parametrize("constant", [0, 2])
@pytest.mark.parametrize(("spoil", "reason"), BAD)
def test_a_bad_update_is_rolled_back(spoil, reason, constant, caplog):
    shot, untouched = Shot("handheld", noise_px=0.1).run(4), Shot("handheld", noise_px=0.1).run(4)
    if constant:
        for each in (shot, untouched):
            assert each.update(range(4), constant=constant).committed
    sound = shot.images[4]
    shot.images[4] = replace(sound)
    spoil(shot.images[4])
    window = shot.window(range(5), constant=constant)
    result = shot.graph.update(window, 15)
    assert not result.committed
    assert re.search(reason, result.reason), result.reason
    assert result.mirrored == (spoil is mirrored_depth)
    assert caplog.messages == [f"update at frame 4 rolled back: {result.reason}"]
    assert result.covariance == {}
    assert result.window is window
    assert shot.variables() == untouched.variables()
    assert shot.landmarks() == untouched.landmarks()
    assert shot.count() == untouched.count()
    shot.images[4] = sound
    for k in (4, 5):
        result, expected = (each.update(range(k + 1), constant=constant) for each in (shot, untouched))
        assert result.committed
        assert_equal(result.window, expected.window)
        for position, covariance in expected.covariance.items():
            np.testing.assert_array_equal(result.covariance[position], covariance)


def test_a_keyframe_that_hardly_anything_holds_says_so():
    """Whether it sees enough is the mapper's question; if the system is solved at all, the covariance has no doubt."""
    shot = Shot("handheld", noise_px=0.1).run(4)
    tracks = shot.images[4].tracks
    shot.images[4].tracks = replace(tracks.of(np.arange(1)), depth=None)
    result = shot.update(range(5), constant=2)
    if result.committed:
        assert np.diag(result.covariance[4])[3:].max() > 1.0
        assert np.diag(result.covariance[3])[3:].max() < 1e-3
    else:
        assert "indeterminate" in result.reason


@pytest.mark.parametrize("spoil", [None, turned_away])
def test_what_is_prepared_between_updates_changes_nothing(spoil):
    """The copy is that of the graph as it is, also after an update that was rolled back or began another graph."""
    shots = Shot("handheld", noise_px=0.1).run(2), Shot("handheld", noise_px=0.1).run(2)
    for k, constant in ((2, 0), (3, 2), (4, 0), (5, 2)):
        for shot in shots:
            if spoil is not None:
                sound, shot.images[k] = shot.images[k], replace(shot.images[k])
                spoil(shot.images[k])
                assert not shot.update(range(k + 1), constant=constant).committed
                shot.images[k] = sound
            shots[0].graph.prepare()
            assert shot.update(range(k + 1), constant=constant).committed
            shots[0].graph.prepare()
        assert_equal(shots[0].solved, shots[1].solved)
        assert shots[0].count() == shots[1].count()


def test_a_bad_first_update_is_rolled_back():
    shot = Shot("truck")
    sound, shot.images[1] = shot.images[1], replace(shot.images[1])
    not_finite(shot.images[1])
    assert not shot.update(range(2)).committed
    assert shot.variables() == set()
    shot.images[1] = sound
    assert_equal(shot.run().solved, Shot("truck").run().solved)


def fail(monkeypatch, times, error):
    """Let the first trials raise; the number of trials so far."""
    trials, update = [], LiveIsam.update

    def failing(self, *arguments):
        trials.append(self)
        if len(trials) <= times:
            raise error
        return update(self, *arguments)

    monkeypatch.setattr(LiveIsam, "update", failing)
    return trials


def test_what_is_indeterminate_is_tried_again_on_a_graph_built_anew(monkeypatch):
    shot, untouched = Shot("handheld", noise_px=0.1).run(4), Shot("handheld", noise_px=0.1).run(4)
    for each in (shot, untouched):
        assert each.update(range(5), constant=2).committed
    expected = untouched.update(range(FRAMES), constant=2, iterations=25)
    trials = fail(monkeypatch, 1, RuntimeError("Indeterminant linear system"))
    result = shot.update(range(FRAMES), constant=2, iterations=25)
    assert result.committed
    assert len(trials) == 2
    assert shot.graph._live is trials[1]
    assert shot.count()["projection"] == untouched.count()["projection"]
    assert_same(result.window, expected.window, 1e-5)


@pytest.mark.parametrize("error", [RuntimeError("first line\nsecond"), MemoryError()])
def test_a_solver_that_fails_is_no_update(monkeypatch, error):
    """Whatever it raises, with or without a message."""
    shot = Shot("truck").run(3)
    before = shot.graph._live
    trials = fail(monkeypatch, 99, error)
    window = shot.window(range(4), constant=2)
    result = shot.graph.update(window, 3)
    assert not result.committed
    assert len(trials) == 3
    assert re.search(r"indeterminate \((first line|MemoryError\(\))\)$", result.reason)
    assert result.window is window
    assert shot.graph._live is before


def test_a_position_can_be_taken_only_once():
    shot = Shot("truck", guided=()).run(2)
    window = replace(shot.window(range(3)), keyframes=np.array([0, 1, 1]))
    result = shot.graph.update(window, 3)
    assert not result.committed
    assert "already exists" in result.reason
    assert shot.variables() == {X(0), X(1)}
