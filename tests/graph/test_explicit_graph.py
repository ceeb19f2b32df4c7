"""A result as an explicit graph: the same numbers, the same minimum, and room for factors of one's own."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pycolmap
import pytest
from gtsam.symbol_shorthand import A, L, T, X

from factorsfm import Options, Reconstruction, ShotKind, Stream, factor_graph
from factorsfm.graph.factors import affine_of_native
from factorsfm.synthetic import Motion
from tests.exact_result import build
from tests.rendered import FRAMES, Maps, rendered, simulated_maps, with_fewer_tracks


@cache
def result(motion: Motion, guided: bool = True) -> Reconstruction:
    shot = rendered(motion)
    prior = Maps(simulated_maps(motion)) if guided else None
    stream = Stream(shot.camera, depth=prior, options=with_fewer_tracks(Options()))
    for image in shot.images:
        stream.push(image)
    return stream.finish()


def optimized(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    return gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()


def factors_of(graph: gtsam.NonlinearFactorGraph, kind: type) -> list[gtsam.NoiseModelFactor]:
    return [graph.at(k) for k in range(graph.size()) if isinstance(graph.at(k), kind)]


def moved(a: gtsam.Values, b: gtsam.Values, unit: float = 1.0) -> np.ndarray:
    """(frames, 6) of the poses, those of `b` in another unit of length."""
    poses = [b.atPose3(X(i)) for i in range(FRAMES)]
    poses = [gtsam.Pose3(pose.rotation(), unit * pose.translation()) for pose in poses]
    return np.array([a.atPose3(X(i)).localCoordinates(pose) for i, pose in enumerate(poses)])


def mean_inverse_distance(values: gtsam.Values, count: int) -> float:
    return float(np.mean([1.0 / np.linalg.norm(values.atPoint3(L(j))) for j in range(count)]))


def test_it_holds_every_observation_and_every_variable() -> None:
    r = result("dolly")
    graph, values = factor_graph(r)
    guided = [i for i, frame in enumerate(r.frames) if frame.prior]
    keys = [X(i) for i in range(FRAMES)] + [L(j) for j in range(len(r.points))] + [A(i) for i in guided] + [T(0)]
    assert sorted(values.keys()) == sorted(keys)
    for i, frame in enumerate(r.frames):
        center = frame.cam_from_world.inverse().translation
        np.testing.assert_allclose(values.atPose3(X(i)).translation(), center, atol=1e-12)
    projections = factors_of(graph, gtsam.GenericProjectionFactorCal3_S2)
    errors = [np.linalg.norm(factor.unwhitenedError(values)) for factor in projections]
    np.testing.assert_allclose(errors, r.observation_error, atol=1e-9)
    assert graph.size() == len(errors) + np.isfinite(r.prior_residual).sum() + len(keys)


def test_the_prior_s_residuals_are_those_of_the_result() -> None:
    r = result("dolly")
    graph, values = factor_graph(r)
    guided = np.isfinite(r.prior_residual)
    assert guided.sum() > 100
    depth = [graph.at(k) for k in range(graph.size()) if graph.at(k).keys()[1:2] == [T(0)]]
    found = np.array([factor.unwhitenedError(values)[0] for factor in depth])
    frame, point = r.observation_frame[guided], r.observation_point[guided]
    scale = np.array([r.frames[i].prior.scale for i in frame])
    z = [(r.frames[i].cam_from_world * r.points[j])[2] for i, j in zip(frame, point, strict=True)]
    expected = r.prior_residual[guided] * scale / z
    np.testing.assert_allclose(np.sort(found), np.sort(expected), atol=2e-4 * np.median(scale / z))


@pytest.mark.parametrize(("motion", "guided"), [("dolly", True), ("handheld", True), ("handheld", False)])
def test_the_result_is_its_minimum(motion: Motion, guided: bool) -> None:
    r = result(motion, guided)
    graph, values = factor_graph(r)
    found = optimized(graph, values)
    before, after = graph.error(values), graph.error(found)
    assert 0.99 * before < after <= before
    unit = mean_inverse_distance(found, len(r.points)) / mean_inverse_distance(values, len(r.points))
    assert unit == pytest.approx(1.0, abs=0.005)
    deviations = [np.sqrt(np.diag(frame.covariance)) for frame in r.frames]
    for step, std in zip(moved(values, found, unit)[1:], deviations[1:], strict=True):
        assert (np.abs(step) < std).all()
    np.testing.assert_allclose(moved(values, found)[0], 0.0, atol=1e-12)
    priors = {i: frame.prior for i, frame in enumerate(r.frames) if frame.prior is not None}
    assert bool(priors) == guided
    for i, prior in priors.items():
        scale, shift = affine_of_native(found.atCal3_S2(A(i)))
        assert unit * scale == pytest.approx(prior.scale, abs=0.3 * prior.scale_std)
        assert shift == pytest.approx(prior.shift, abs=0.3 * prior.shift_std)


def test_it_finds_back_to_the_minimum() -> None:
    graph, values = factor_graph(result("dolly"))
    start = gtsam.Values(values)
    rng = np.random.default_rng(0)
    for i in range(1, FRAMES):
        start.update(X(i), values.atPose3(X(i)).retract(1e-3 * rng.standard_normal(6)))
    before = graph.error(values)
    assert graph.error(start) > 5 * before
    assert graph.error(optimized(graph, start)) < 1.001 * before


def test_a_measured_length_sets_the_scale() -> None:
    r = result("dolly")
    graph, values = factor_graph(r)
    travel = np.linalg.norm(values.atPose3(X(FRAMES - 1)).translation())
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3 * travel)
    graph.add(gtsam.RangeFactorPose3(X(0), X(FRAMES - 1), 2.0 * travel, noise))
    found = optimized(graph, values)
    assert np.linalg.norm(found.atPose3(X(FRAMES - 1)).translation()) == pytest.approx(2.0 * travel, rel=2e-5)
    points = np.array([found.atPoint3(L(j)) for j in range(len(r.points))])
    ratio = np.linalg.norm(points, axis=1) / np.linalg.norm(r.points, axis=1)
    assert np.median(ratio) == pytest.approx(2.0, rel=0.001)


@pytest.mark.parametrize(("motion", "kind"), [("rotation", ShotKind.ROTATION), ("static", ShotKind.STATIC)])
def test_a_camera_that_only_turns_stays_where_it_is(motion: Motion, kind: ShotKind) -> None:
    r = result(motion)
    assert r.kind is kind
    graph, values = factor_graph(r)
    found = optimized(graph, values)
    np.testing.assert_allclose(moved(values, found)[:, 3:], 0.0, atol=1e-6)
    assert graph.error(found) == pytest.approx(graph.error(values), rel=0.03, abs=1e-15)


def test_distortion_and_frames_without_a_pose_are_taken_into_account() -> None:
    r = build()
    assert r.camera.model_name == "OPENCV"
    graph, values = factor_graph(r)
    projections = factors_of(graph, gtsam.GenericProjectionFactorCal3_S2)
    assert len(projections) == len(r.registered) * len(r.points) < len(r.observation_xy)
    assert max(np.linalg.norm(factor.unwhitenedError(values)) for factor in projections) < 2e-9
    assert not values.exists(X(3))
    assert values.exists(A(4))
    straight = replace(r, camera=pycolmap.Camera(model="PINHOLE", width=640, height=480, params=r.camera.params[:4]))
    projections = factors_of(factor_graph(straight)[0], gtsam.GenericProjectionFactorCal3_S2)
    assert max(np.linalg.norm(factor.unwhitenedError(values)) for factor in projections) > 0.3
