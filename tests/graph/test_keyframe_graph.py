"""iSAM2 over keyframes: the truth, the steps and covariances of the dense solver, and updates that are all or nothing.

`Shot` is the least mapper there can be: it hands window after window to the graph and keeps what comes back.
"""

import re
from copy import deepcopy
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from gtsam.symbol_shorthand import A, F, X

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.prior_term import WeighedPrior, joint_problem
from factorsfm.adjustment.prior_weight import PriorWeight
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.graph.keyframe_graph import FactorGraph
from factorsfm.support.options import PolishOptions
from tests.estimation_problems import angles_between, in_unit_of, make_problem, mapped_images, perturbed

FRAMES = 6
SIGMA = 0.25  # pixels
EXACT = PolishOptions(tolerance=1e-10, point_sigma=3.0)  # the prior of the points only keeps the unit of length
GOOD_PRIOR = PriorWeight(smooth=0.05, local=0.02, length=0.3, correlation=1.0)


class Shot:
    """Keyframes of a synthetic shot, with a first guess away from the truth."""

    def __init__(self, motion="handheld", *, noise_px=0.0, guided=range(FRAMES), affine=(1.0, 0.0), seed=0):
        self.problem = make_problem(motion, frames=FRAMES, points=80, parallax=0.1, noise_px=noise_px, seed=seed)
        guess = perturbed(self.problem.truth, seed, angle_rad=0.002, shift=0.005, structure=0.05)
        self.images = mapped_images(self.problem, guess, guided=guided, scale=affine[0], shift=affine[1])
        self.points = guess.points
        self.half = len(self.points) // 2  # known from the first keyframe on; the rest appears in the third
        self.graph = FactorGraph()
        self.state = None

    def adjustment(self, frames, *, held=1, options=EXACT):
        """The problem of some keyframes, the first `held` of them constant, and which of them carry a prior."""
        window = [self.images[k] for k in frames]
        ids = np.arange(len(self.points) if max(frames) >= 2 else self.half)
        distance = np.linalg.norm(self.points[ids], axis=1)
        state = State(
            np.array([image.rotation for image in window]),
            np.array([image.translation for image in window]),
            self.points[ids] / distance[:, None],
            1.0 / distance,
            np.log([self.problem.focal]),
        )
        fixed, o = np.arange(len(frames)) < held, gather([image.tracks for image in window], ids)
        guided = [k for k in frames if self.images[k].tracks.depth is not None]
        if not guided:
            return BundleAdjustment(state, o, options, ErrorModel(SIGMA), free=Free(held=fixed)), []
        scale, shift = np.array([self.images[k].affine or (1.0, 0.0) for k in guided]).T
        rows = np.array([list(frames).index(k) for k in guided])
        weighed = WeighedPrior(GOOD_PRIOR, rows, scale, shift, 1.0)
        return joint_problem(state, o, ids, [image.tracks for image in window], weighed, SIGMA, options, fixed)[
            0
        ], guided

    def solve(self, adjustment, frames, guided, *, iterations=15):
        return self.graph.update(adjustment, list(frames), guided, iterations)

    def update(self, frames, *, held=1, **kwargs):
        """One update of the graph, kept if it is committed."""
        adjustment, guided = self.adjustment(frames, held=held)
        result = self.solve(adjustment, frames, guided, **kwargs)
        if result.committed:
            self.state = state = adjustment.state
            for row, k in enumerate(frames):
                self.images[k].rotation, self.images[k].translation = state.rotation[row], state.translation[row]
            for k, affine in zip(guided, zip(state.scale, state.shift, strict=True), strict=True):
                self.images[k].affine = affine
            self.points[: len(state.bearing)] = state.points
        return result

    def run(self, frames=FRAMES, **kwargs):
        for k in range(1, frames):
            result = self.update(range(k + 1), **kwargs)
            assert result.committed, result.reason
        return self

    def variables(self):
        return set(self.graph._isam.getLinearizationPoint().keys())


def errors(shot):
    """Largest error of a rotation (radians) and of a translation, median relative error of the points."""
    truth, state = shot.problem.truth, in_unit_of(shot.state, shot.problem.truth)
    depth = np.linalg.norm(state.points - shot.problem.points, axis=1) * truth.inverse_distance
    shift = np.linalg.norm(state.translation - truth.translation, axis=1)
    return np.array([angles_between(state.rotation, truth.rotation).max(), shift.max(), np.median(depth)])


def assert_same(state, other, tolerance):
    for name in State.__dataclass_fields__:
        np.testing.assert_allclose(getattr(state, name), getattr(other, name), rtol=0, atol=tolerance, err_msg=name)


# --- convergence ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guided", [(), range(FRAMES)])
@pytest.mark.parametrize("motion", ["truck", "handheld", "dolly"])
def test_exact_observations_lead_to_the_truth(motion, guided):
    shot = Shot(motion, guided=guided).run()
    assert (errors(shot) < [1e-6, 1e-6, 1e-5]).all()
    np.testing.assert_allclose(shot.state.scale, 1.0, atol=1e-3)
    np.testing.assert_allclose(shot.state.shift, 0.0, atol=1e-3)
    np.testing.assert_allclose(shot.state.field, 0.0, atol=1e-3)
    assert len(shot.state.scale) == len(guided)


def test_few_steps_per_update_are_enough():
    """Three, as the mapper takes: every update goes on from the one before."""
    assert (errors(Shot("handheld").run(iterations=3)) < [1e-5, 1e-5, 1e-4]).all()


@pytest.mark.parametrize("motion", ["truck", "handheld"])
def test_scale_and_shift_of_the_prior_are_found(motion):
    """As far as they are not believed to be 1 and 0; the unit of length may follow the scale."""
    shot = Shot(motion, affine=(1.3, 0.15)).run()
    assert (errors(shot) < [6e-4, 6e-4, 2e-3]).all()
    unit = np.median(shot.state.inverse_distance / shot.problem.truth.inverse_distance)
    np.testing.assert_allclose(shot.state.scale * unit, 1.3, atol=0.02)
    np.testing.assert_allclose(shot.state.shift, 0.15, atol=0.03)


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
    assert shot.variables() == {X(1), X(2)}
    for k in range(3, FRAMES):
        assert shot.update(range(k + 1)).committed
    assert shot.variables() == {X(k) for k in range(1, FRAMES)} | {A(3), A(5), F(0)}
    assert (errors(shot) < [5e-6, 5e-6, 1e-4]).all()


def test_constant_keyframes_stay_where_they_are():
    shot = Shot("handheld").run(4)
    before = [shot.images[k].pose for k in range(3)]
    assert set(shot.update(range(5), held=3).covariance) == {3, 4}
    for k, (rotation, translation) in enumerate(before):
        np.testing.assert_allclose(shot.state.rotation[k], rotation, atol=1e-15)
        np.testing.assert_allclose(shot.state.translation[k], translation, atol=1e-15)


# --- beside the dense solver ------------------------------------------------------------------------------------


@pytest.mark.parametrize("guided", [(), (0, 2)])
def test_steps_are_newtons(guided):
    shot = Shot("handheld", noise_px=SIGMA, guided=guided)
    adjustment, rows = shot.adjustment(range(5))
    dense, _ = shot.adjustment(range(5))
    start = dense.state
    # iSAM2 linearises at its own estimate, and turns and moves at once: what is left is of second order.
    for tolerance in (1e-4, 1e-5, 3e-6):
        assert shot.solve(adjustment, range(5), rows, iterations=1).committed
        dense.solve(1)
        assert_same(adjustment.state, dense.state, tolerance)
    assert np.abs(dense.state.translation - start.translation).max() > 1e-3


@pytest.mark.parametrize("guided", [(), range(FRAMES)])
def test_the_optimum_is_that_of_the_dense_solver(guided):
    shot = Shot("handheld", noise_px=SIGMA, guided=guided).run(FRAMES - 1)
    adjustment, rows = shot.adjustment(range(FRAMES))
    dense, _ = shot.adjustment(range(FRAMES))
    assert shot.solve(adjustment, range(FRAMES), rows).committed
    dense.solve(15)
    assert adjustment.cost() == pytest.approx(dense.cost(), rel=1e-9)
    assert_same(adjustment.state, dense.state, 1e-5)


@pytest.mark.parametrize("guided", [(), (0, 3, 5)])
def test_covariances_are_those_of_the_dense_solver(guided):
    shot = Shot("handheld", noise_px=SIGMA, guided=guided)
    frames, held = range(FRAMES), 2  # two constant cameras: the unit of length is known
    adjustment, rows = shot.adjustment(frames, held=held)
    result = shot.solve(adjustment, frames, rows)
    camera = adjustment.marginals().camera
    assert list(result.covariance) == list(frames[held:])
    for k, covariance in result.covariance.items():
        expected = camera[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(covariance / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=2e-3)


@pytest.mark.parametrize("guided", [(), (0, 3, 5)])
def test_the_mappers_three_steps_give_covariances_roughly(guided):
    """They carry the damping of the last step."""
    shot = Shot("handheld", noise_px=SIGMA, guided=guided)
    adjustment, rows = shot.adjustment(range(FRAMES), held=2, options=PolishOptions(tolerance=1e-3))
    result = shot.solve(adjustment, range(FRAMES), rows, iterations=3)
    camera = adjustment.marginals().camera
    said = np.concatenate([np.diag(covariance) for covariance in result.covariance.values()])
    ratio = np.sqrt(said / np.diag(camera)[12 : 6 * FRAMES])
    assert 0.85 < ratio.min() <= ratio.max() < 1.2


# --- the window -------------------------------------------------------------------------------------------------


def test_keyframes_that_leave_the_window_leave_the_graph():
    shot = Shot("handheld", guided=(0, 2, 5)).run(4)
    assert shot.variables() == {X(1), X(2), X(3), A(0), A(2), F(0)}
    assert shot.update(range(1, 5), held=2).committed
    assert shot.variables() == {X(3), X(4), A(2), F(0)}
    assert shot.update([1, 3, 4]).committed
    assert shot.variables() == {X(3), X(4)}
    assert shot.update([0, 3, 4, 5]).committed
    assert shot.variables() == {X(3), X(4), X(5), A(0), A(5), F(0)}


def test_the_landmarks_are_one_factor_always():
    factors = Shot("handheld").run(4).graph._isam.getFactorsUnsafe()
    assert factors.nrFactors() == 1
    assert factors.size() <= 2  # slots are used again


def test_a_moving_window_leads_to_the_truth():
    shot = Shot("handheld").run(3)
    for k in range(3, FRAMES):
        assert shot.update(range(k - 2, k + 1), held=2).committed
    assert shot.update(range(FRAMES)).committed
    assert (errors(shot) < [1e-6, 1e-6, 1e-5]).all()


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


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (turned_away, "landmarks lie behind the camera"),
        (wrong_tracks, r"the median reprojection error is [\d.]+ pixels, at most 10 expected"),
        (no_observations, "the keyframe observes no landmark"),
        (not_finite, "indeterminate"),
        (mirrored_depth, "the depth is mirrored"),
    ],
)
def test_a_bad_update_is_rolled_back(spoil, reason, caplog):
    shot, untouched = Shot("handheld", noise_px=0.1).run(4), Shot("handheld", noise_px=0.1).run(4)
    sound = shot.images[4]
    shot.images[4] = replace(sound)
    spoil(shot.images[4])
    adjustment, guided = shot.adjustment(range(5))
    before, copy = adjustment.state, deepcopy(adjustment.state)
    result = shot.solve(adjustment, range(5), guided)
    assert not result.committed
    assert re.search(reason, result.reason)
    assert f"update at frame 4 rolled back: {result.reason}" in caplog.text
    assert result.covariance == {}
    assert adjustment.state is before
    assert_same(adjustment.state, copy, 0.0)
    assert shot.variables() == untouched.variables()
    shot.images[4] = sound
    for k in (4, 5):
        result, expected = shot.update(range(k + 1)), untouched.update(range(k + 1))
        assert result.committed
        for position, covariance in expected.covariance.items():
            np.testing.assert_array_equal(result.covariance[position], covariance)
    assert_same(shot.state, untouched.state, 0.0)


def test_a_keyframe_that_hardly_anything_holds_says_so():
    """Whether it sees enough is the mapper's question; the covariance has no doubt."""
    shot = Shot("handheld", noise_px=0.1).run(4)
    tracks = shot.images[4].tracks
    shot.images[4].tracks = replace(tracks.of(np.arange(1)), depth=None)
    result = shot.update(range(5))
    if result.committed:
        assert np.diag(result.covariance[4])[3:].max() > 1.0
        assert np.diag(result.covariance[3])[3:].max() < 1e-3
    else:
        assert "indeterminate" in result.reason


def test_a_bad_first_update_is_rolled_back():
    shot = Shot("truck")
    sound, shot.images[1] = shot.images[1], replace(shot.images[1])
    not_finite(shot.images[1])
    assert not shot.update(range(2)).committed
    assert shot.variables() == set()
    shot.images[1] = sound
    assert_same(shot.run().state, Shot("truck").run().state, 0.0)


def test_a_solver_that_fails_is_no_update():
    """Whatever it raises, with or without a message."""
    shot = Shot("truck").run(3)
    for error in (RuntimeError("first line\nsecond"), MemoryError()):
        adjustment, guided = shot.adjustment(range(4))
        before = adjustment.state
        adjustment.solve = Mock(side_effect=error)
        result = shot.solve(adjustment, range(4), guided)
        assert not result.committed
        assert re.search(r"\((first line|MemoryError\(\))\)$", result.reason)
        assert adjustment.state is before


def test_a_position_can_be_taken_only_once():
    shot = Shot("truck", guided=()).run(2)
    adjustment, _ = shot.adjustment(range(3))
    result = shot.graph.update(adjustment, [0, 1, 1], [], 3)
    assert not result.committed
    assert "already exists" in result.reason
    assert shot.variables() == {X(1)}
