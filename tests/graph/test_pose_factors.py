"""A result as factors on its poses: measured covariances of poses and of neighbours, from both sides."""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pycolmap
import pytest
from gtsam.symbol_shorthand import X

from factorsfm import InputError, pose_factors, read_result
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import in_scene_unit, pose_covariances
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.graph.factors import pose_from_camera
from factorsfm.support.options import PolishOptions
from tests.estimation_problems import make_problem
from tests.exact_result import build
from tests.graph.results import longer_result, result


@cache
def solved(motion: str, frames: int) -> tuple[State, np.ndarray]:
    """A synthetic shot at its minimum, and the covariance of its camera side."""
    problem = make_problem(motion, frames=frames, points=200, noise_px=0.3)
    adjustment = BundleAdjustment(problem.truth, problem.observations, PolishOptions(), ErrorModel(0.3))
    state = adjustment.solve()
    return state, in_scene_unit(adjustment.marginals(), state)


def covariances(state: State, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows = np.arange(len(state.rotation))
    return pose_covariances(camera, np.tile(np.eye(6), (len(rows), 1, 1)), Columns.of(state).pose(rows), state)


def frames_of(state: State, covariance: np.ndarray, relative: np.ndarray) -> list[Any]:
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(r), t) for r, t in zip(state.rotation, state.translation, strict=True)
    ]
    return [
        SimpleNamespace(index=3 + 2 * k, cam_from_world=pose, covariance=c, relative_covariance=r if k else None)
        for k, (pose, c, r) in enumerate(zip(poses, covariance, relative, strict=True))
    ]


def beside_the_result(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, frames: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of the poses, and of each relative to the one before, over those of the result."""
    marginals, single, pairs = gtsam.Marginals(graph, values), [], []
    for before, frame in pairwise(frames):
        keys = [X(before.index), X(frame.index)]
        joint = marginals.jointMarginalCovariance(keys)
        covariance = np.block([[joint.at(a, b) for b in keys] for a in keys])
        by_both = np.hstack([-values.atPose3(keys[1]).between(values.atPose3(keys[0])).AdjointMap(), np.eye(6)])
        single.append(np.diag(covariance)[6:] / np.diag(frame.covariance))
        pairs.append(np.diag(by_both @ covariance @ by_both.T) / np.diag(frame.relative_covariance))
    return np.sqrt(single), np.sqrt(pairs)


def held(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, first: int) -> gtsam.NonlinearFactorGraph:
    graph.add(gtsam.PriorFactorPose3(X(first), values.atPose3(X(first)), gtsam.noiseModel.Isotropic.Sigma(6, 1e-8)))
    return graph


def test_the_relative_covariance_is_that_of_the_relative_pose() -> None:
    state, camera = solved("handheld", 6)
    _, relative = covariances(state, camera)
    poses = [pose_from_camera(r, t) for r, t in zip(state.rotation, state.translation, strict=True)]
    before, pose, step = poses[3], poses[4], 1e-6
    exact = before.between(pose)
    by_both = np.zeros((6, 12))
    for axis in range(12):
        tangent = step * np.eye(12)[axis]
        changed = before.retract(tangent[:6]).between(pose.retract(tangent[6:]))
        by_both[:, axis] = exact.localCoordinates(changed) / step
    size = np.sqrt(np.diag(relative[4]))
    expected = by_both @ camera[18:30, 18:30] @ by_both.T
    np.testing.assert_allclose(relative[4] / np.outer(size, size), expected / np.outer(size, size), atol=1e-4)
    np.testing.assert_array_equal(relative[0], 0.0)


def test_relative_poses_are_as_wrong_as_their_covariances_say() -> None:
    wrong = []
    for seed in range(8):
        problem = make_problem("handheld", frames=10, points=200, noise_px=0.3, seed=seed)
        truth = problem.truth
        adjustment = BundleAdjustment(truth, problem.observations, PolishOptions(), ErrorModel(0.3))
        state = adjustment.solve()
        _, relative = covariances(state, in_scene_unit(adjustment.marginals(), state))
        unit = state.inverse_distance.mean() / truth.inverse_distance.mean()
        exact = [pose_from_camera(r, t) for r, t in zip(truth.rotation, truth.translation, strict=True)]
        found = [pose_from_camera(r, unit * t) for r, t in zip(state.rotation, state.translation, strict=True)]
        for k in range(1, 10):
            error = exact[k - 1].between(exact[k]).localCoordinates(found[k - 1].between(found[k]))
            wrong.append(error @ np.linalg.solve(relative[k], error) / 6)
    assert 0.7 < np.mean(wrong) < 1.4


@pytest.mark.parametrize(
    ("motion", "frames", "single", "pairs"),
    [
        ("dolly", 30, (0.999, 1.001), (0.999, 1.001)),
        ("truck", 30, (0.95, 1.01), (0.99, 1.02)),
        ("handheld", 30, (0.93, 1.02), (0.98, 1.01)),
        ("handheld", 60, (0.99, 1.005), (0.998, 1.002)),
        ("handheld", 10, (0.7, 1.2), (0.8, 1.25)),
        ("truck", 3, (0.99, 1.01), (0.99, 1.8)),
    ],
)
def test_poses_and_pairs_are_as_certain_as_in_the_result(
    motion: str, frames: int, single: tuple[float, float], pairs: tuple[float, float]
) -> None:
    state, camera = solved(motion, frames)
    shot = SimpleNamespace(frames=frames_of(state, *covariances(state, camera)), control=None)
    graph, values = pose_factors(shot)
    assert graph.size() == 2 * frames - 3
    assert graph.error(values) < 1e-15
    beside = beside_the_result(held(graph, values, 3), values, shot.frames)
    for found, (least, most) in zip(beside, (single, pairs), strict=True):
        assert least < found.min() <= found.max() < most


def test_a_chain_of_the_relative_poses_alone_would_get_worse_and_worse() -> None:
    state, camera = solved("handheld", 30)
    frames = frames_of(state, *covariances(state, camera))
    values, chain = pose_factors(SimpleNamespace(frames=frames, control=None))[1], gtsam.NonlinearFactorGraph()
    for before, frame in pairwise(frames):
        a, b, noise = X(before.index), X(frame.index), gtsam.noiseModel.Gaussian.Covariance(frame.relative_covariance)
        chain.add(gtsam.BetweenFactorPose3(a, b, values.atPose3(a).between(values.atPose3(b)), noise))
    single, pairs = beside_the_result(held(chain, values, 3), values, frames)
    np.testing.assert_allclose(pairs, 1.0, atol=1e-3)
    assert 4.0 < single[-1].min() < single[-1].max() < 5.5


def test_a_rendered_shot_and_its_frames_without_a_covariance() -> None:
    r = longer_result()
    graph, values = pose_factors(r)
    single, pairs = beside_the_result(held(graph, values, 0), values, r.frames)
    assert 0.9 < single.min() <= single.max() < 1.1
    assert 0.9 < pairs.min() <= pairs.max() < 1.1
    assert r.frames[0].relative_covariance is None
    assert set(values.keys()) == {X(i) for i in range(40)}


def test_under_control_every_pose_has_a_prior_and_what_is_held_stays() -> None:
    state, camera = solved("dolly", 30)
    known = np.repeat(np.isin(np.arange(len(camera) // 6 + 1), [0, 12]), 6)[: len(camera)]
    covariance, relative = covariances(state, np.where(known | known[:, None], 0.0, camera))
    shot = SimpleNamespace(frames=frames_of(state, covariance, relative), control=object())
    graph, values = pose_factors(shot)
    priors = [graph.at(k) for k in range(graph.size()) if isinstance(graph.at(k), gtsam.PriorFactorPose3)]
    assert len(priors) == 30 == graph.size() - 29
    marginals = gtsam.Marginals(graph, values)
    for frame, c in zip(shot.frames, covariance, strict=True):
        found = np.sqrt(np.diag(marginals.marginalCovariance(X(frame.index))))
        np.testing.assert_allclose(found, np.sqrt(np.diag(c) + 1e-14), rtol=0.01)
    assert np.sqrt(np.diag(marginals.marginalCovariance(X(27)))).max() < 2e-7


def test_a_camera_that_only_turns_stays_where_it_is() -> None:
    r = result("rotation")
    graph, values = pose_factors(r)
    marginals = gtsam.Marginals(held(graph, values, 0), values)
    for frame in r.frames[1:]:
        found = np.sqrt(np.diag(marginals.marginalCovariance(X(frame.index))))
        np.testing.assert_allclose(found[:3], np.sqrt(np.diag(frame.covariance))[:3], rtol=0.1)
        assert found[3:].max() < 2e-7


def test_frames_without_a_covariance_are_left_out(tmp_path: Path) -> None:
    r = result("dolly", guided=False)
    covariance, r.frames[4].relative_covariance = r.frames[4].relative_covariance, None
    try:
        graph, values = pose_factors(r)
    finally:
        r.frames[4].relative_covariance = covariance
    assert not values.exists(X(4))
    assert graph.size() == 6 + 5
    r.write(tmp_path)
    with pytest.raises(InputError, match="0 of 8 registered frames have a covariance relative to the one before"):
        pose_factors(read_result(tmp_path))
    with pytest.raises(InputError, match="0 of 5"):
        pose_factors(build())
