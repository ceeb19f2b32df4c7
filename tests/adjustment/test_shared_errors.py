from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment import shared_errors as module
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import in_scene_unit
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.shared_errors import SharedErrors, _neighbourhoods, in_scene_unit_with, shared_errors
from factorsfm.graph.factors import pose_from_camera
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import exponential
from tests.calibration import normalised, pose_errors
from tests.estimation_problems import make_problem

GAUSSIAN = PolishOptions(kernel=1e6, tolerance=1e-8, point_sigma=1e3)
WHITE = 0.1  # pixels
TRIALS = 8


@pytest.fixture(scope="module")
def shot():
    return make_problem("truck", frames=6, points=300, parallax=0.1)


def smooth(shot, size, rng):
    """(m, 2) errors of neighbours in each frame, of the law that the model takes them to have; `size` in pixels."""
    o, error = shot.observations, np.zeros((len(shot.observations.point), 2))
    width = np.ptp(o.pixels[:, 0])
    for frame in range(shot.frames):
        rows = np.flatnonzero(o.frame == frame)
        distance = np.linalg.norm(o.pixels[rows, None] - o.pixels[rows], axis=2) / width
        covariance = 1.0 / (1.0 + 48.0 * distance) + 1e-9 * np.eye(len(rows))
        error[rows] = size * np.linalg.cholesky(covariance) @ rng.standard_normal((len(rows), 2))
    return error


def by_neighbourhood(shot, size, rng):
    """(m, 2) errors that the tracks of a neighbourhood have together, another in each frame; `size` in pixels."""
    o, label = shot.observations, _neighbourhoods(shot.truth.bearing)
    return size * rng.standard_normal((label.max() + 1, shot.frames, 2))[label[o.point], o.frame]


def by_view(shot, size, rng):
    """(m, 2) errors that grow along the path, quadratic in the place; `size` in pixels."""
    o = shot.observations
    x, y = (o.pixels / np.abs(o.pixels).max(0)).T
    way = np.linalg.norm(shot.truth.translation, axis=1)  # of a path along a straight line, from the first camera
    fields = np.stack([x, y, x * x, x * y, y * y], 1) * (way / way.max())[o.frame, None]
    return size * fields @ rng.standard_normal((5, 2))


def solved(shot, error):
    seen = replace(shot.observations, pixels=shot.observations.pixels + error)
    adjustment = BundleAdjustment(shot.truth, seen, GAUSSIAN, ErrorModel(WHITE))
    adjustment.solve()
    return adjustment


def in_unit(state, truth):
    unit = state.inverse_distance.mean() / truth.inverse_distance.mean()
    return replace(state, translation=state.translation * unit, inverse_distance=state.inverse_distance / unit)


def ratios(shot, draw, size):
    """Mean squared normalised errors of the poses and of the points, with what neighbours share and without."""
    found = []
    poses = slice(6, 6 * shot.frames)
    for seed in range(TRIALS):
        rng = np.random.default_rng([seed, 17])
        adjustment = solved(
            shot, draw(shot, size, rng) + WHITE * rng.standard_normal((len(shot.observations.point), 2))
        )
        marginals, state = adjustment.marginals(), adjustment.state
        alone = in_scene_unit(marginals, state)
        both, std = in_scene_unit_with(shared_errors(adjustment, marginals), marginals, state)
        state = in_unit(state, shot.truth)
        error = pose_errors(state, shot.truth)
        row = []
        for covariance, deviation in ((both, std), (alone, marginals.inverse_distance_std(alone))):
            each = [normalised(e, c)[0] / 6 for e, c in pose_blocks(error, covariance[poses, poses])]
            points = (state.inverse_distance - shot.truth.inverse_distance) / deviation
            row += [np.mean(each), np.mean(points**2)]
        found.append(row)
    return np.mean(found, axis=0)


def pose_blocks(error, covariance):
    for k in range(0, len(error), 6):
        yield error[k : k + 6], covariance[k : k + 6, k : k + 6]


@pytest.fixture
def no_errors_by_view(monkeypatch):
    monkeypatch.setattr(module, "_BY_VIEW_PX", 0.0)


@pytest.mark.usefixtures("no_errors_by_view")
def test_of_independent_errors_covariances_are_at_most_twice_too_large(shot):
    """What single tracks do is in both parts of the covariance."""
    poses, points, alone, points_alone = ratios(shot, smooth, 0.0)
    assert 0.8 < alone < 1.2
    assert 0.35 < poses < 0.65
    assert 0.9 < points_alone < 1.1
    assert 0.6 < points < 0.9


@pytest.mark.usefixtures("no_errors_by_view")
def test_smooth_errors_of_frames_are_in_the_covariance(shot):
    poses, points, alone, points_alone = ratios(shot, smooth, 0.2)
    assert alone > 20.0
    assert 0.6 < poses < 1.4
    assert points_alone > 5.0
    assert 1.4 < points < 2.6  # of six frames each point shares the errors with its neighbours alone, too


@pytest.mark.usefixtures("no_errors_by_view")
def test_errors_of_neighbourhoods_are_in_the_covariance(shot):
    poses, points, alone, points_alone = ratios(shot, by_neighbourhood, 0.1)
    assert alone > 8.0
    assert 0.45 < poses < 1.0
    assert points_alone > 4.0
    assert 1.1 < points < 2.0


@pytest.mark.parametrize("size", [0.1, 0.3])
def test_errors_that_grow_with_the_change_of_view_are_in_the_covariance(shot, monkeypatch, size):
    """No residual shows them: the solution takes them for another path and other distances."""
    monkeypatch.setattr(module, "_BY_VIEW_PX", 0.0)
    shown, *_ = ratios(shot, by_view, size)
    monkeypatch.setattr(module, "_BY_VIEW_PX", size)
    poses, points, *_ = ratios(shot, by_view, size)
    assert shown > 5.0 * poses
    assert 0.55 < poses < 0.85
    assert 0.45 < points < 0.75


def test_a_neighbourhood_moves_the_solution_as_far_as_without_it(shot):
    rng = np.random.default_rng(3)
    adjustment = solved(shot, by_neighbourhood(shot, 0.3, rng) + WHITE * rng.standard_normal((len(shot.xy), 2)))
    o, label = adjustment.observations, _neighbourhoods(adjustment.state.bearing)
    moved = shared_errors(adjustment, adjustment.marginals()).camera
    for which in (0, 7, 13, 23):
        others = np.flatnonzero(label != which)
        without = BundleAdjustment(
            adjustment.state.of(others), o.of(others), adjustment.options, ErrorModel(adjustment.sigma)
        )
        without.solve()
        expected = -pose_errors(without.state, adjustment.state)
        wrong = np.linalg.norm(moved[6 : 6 * shot.frames, which] - expected)
        assert wrong < 0.15 * np.linalg.norm(expected)


def test_the_error_of_the_first_frame_moves_everything_else(shot):
    state, step = shot.truth, 1e-5
    columns, k = Columns.of(state), shot.frames
    for axis in range(6):
        frame = np.zeros((k, 6, 6))
        frame[0, axis, axis] = step**2
        shared = SharedErrors(np.zeros((columns.size, 1)), np.zeros((len(state.bearing), 1)), frame)
        camera, nearer = shared._by_world(state)
        error = np.zeros(6)
        error[axis] = step
        rotation, translation = state.rotation.copy(), state.translation.copy()
        rotation[0], translation[0] = exponential(-error[None, :3])[0], -error[3:]
        wrong = replace(state, rotation=rotation, translation=translation, world=-1).seen_from(0)
        moved = [
            pose_from_camera(a, b).localCoordinates(pose_from_camera(c, d))
            for a, b, c, d in zip(state.rotation, state.translation, wrong.rotation, wrong.translation, strict=True)
        ]
        found, sign = camera[columns.poses].sum(1), np.sign(camera[6:12].sum(1) @ np.array(moved)[1])
        np.testing.assert_allclose(sign * found, np.ravel(moved), atol=2e-3 * step)
        change = wrong.inverse_distance - state.inverse_distance
        np.testing.assert_allclose(sign * nearer.sum(1), change, atol=2e-3 * step * state.inverse_distance.max() ** 2)
