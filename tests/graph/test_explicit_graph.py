"""A result as an explicit graph: the same numbers, the same minimum, and room for factors of one's own."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pycolmap
import pytest
from gtsam.symbol_shorthand import A, L, T, X

from factorsfm import Reconstruction, ShotKind, factor_graph, read_result
from factorsfm.graph.factors import affine_of_native
from factorsfm.synthetic import Motion
from tests.exact_result import build
from tests.graph.results import longer_result, pose_covariance, result, rolling_result
from tests.rendered import FRAMES


def optimized(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def factors_of(graph: gtsam.NonlinearFactorGraph, *kinds: type) -> list[gtsam.NoiseModelFactor]:
    return [graph.at(k) for k in range(graph.size()) if isinstance(graph.at(k), kinds)]


PROJECTIONS = gtsam.GenericProjectionFactorCal3_S2, gtsam.GeneralSFMFactor2Cal3_S2


def moved(a: gtsam.Values, b: gtsam.Values, unit: float = 1.0) -> np.ndarray:
    """(frames, 6) of the poses, those of `b` in another unit of length."""
    keys = [key for key in list(a.keys()) if gtsam.Symbol(key).chr() == ord("x")]
    poses = [gtsam.Pose3(b.atPose3(key).rotation(), unit * b.atPose3(key).translation()) for key in keys]
    return np.array([a.atPose3(key).localCoordinates(pose) for key, pose in zip(keys, poses, strict=True)])


def unit_of(found: gtsam.Values, r: Reconstruction) -> float:
    """Mean inverse distance of the points beside that of the result."""
    distance = np.linalg.norm([found.atPoint3(L(j)) for j in r.track_ids], axis=1)
    return float(np.mean(1.0 / distance) / np.mean(1.0 / np.linalg.norm(r.points, axis=1)))


def standard_deviations(r: Reconstruction) -> np.ndarray:
    return np.array([np.sqrt(np.diag(frame.covariance)) for frame in r.registered])


def test_it_holds_every_observation_and_every_variable() -> None:
    r = longer_result()
    graph, values = factor_graph(r)
    kept = [key for key in list(values.keys()) if gtsam.Symbol(key).chr() == ord("k")]
    keys = [X(i) for i in range(40)] + [L(j) for j in r.track_ids] + [T(0)]
    assert sorted(values.keys()) == sorted(keys + kept)
    for i, frame in enumerate(r.frames):
        center = frame.cam_from_world.inverse().translation
        np.testing.assert_allclose(values.atPose3(X(i)).translation(), center, atol=1e-12)
    focal, straight = r.camera.mean_focal_length(), gtsam.Values(values)
    for key in kept:
        straight.update(key, gtsam.Cal3_S2(focal, focal, 0, 0, 0))
    errors = [np.linalg.norm(factor.unwhitenedError(straight)) for factor in factors_of(graph, *PROJECTIONS)]
    np.testing.assert_allclose(errors, r.observation_error, atol=1e-9)
    assert graph.size() == len(r.observation_xy) + len(keys) + 1 + len(kept)
    stretches = {(point, frame // 16) for point, frame in zip(r.observation_point, r.observation_frame, strict=True)}
    assert len(kept) == sum(r.noise.track[point] > 0 for point, _ in stretches) > len(r.points)


def test_keys_are_the_indices_of_the_source_and_the_identities_of_the_tracks() -> None:
    r = build()
    _, values = factor_graph(r)
    expected = {X(frame.index) for frame in r.registered} | {L(j) for j in r.track_ids} | {T(0)}
    assert set(values.keys()) == expected
    np.testing.assert_array_equal(values.atPoint3(L(107)), r.points[7])
    np.testing.assert_allclose(
        values.atPose3(X(14)).translation(), r.frames[2].cam_from_world.inverse().translation, atol=1e-12
    )
    guided = result("dolly")
    renamed = replace(guided, frames=[replace(frame, index=100 + frame.index) for frame in guided.frames])
    assert {A(100 + f.index) for f in guided.frames if f.prior} <= set(factor_graph(renamed)[1].keys())


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


@pytest.mark.parametrize(
    ("motion", "guided", "most"),
    [
        ("dolly", True, 0.03), ("handheld", True, 0.1), ("truck", True, 0.1),
        ("dolly", False, 0.006), ("handheld", False, 0.003), ("truck", False, 0.003),
    ],
)  # fmt: skip
def test_the_result_is_its_minimum(motion: Motion, guided: bool, most: float) -> None:
    r = result(motion, guided)
    graph, values = factor_graph(r)
    found = optimized(graph, values)
    unit = unit_of(found, r)
    assert unit == pytest.approx(1.0, abs=0.008)
    assert (np.abs(moved(values, found, unit)[1:]) < most * standard_deviations(r)[1:]).all()
    np.testing.assert_allclose(moved(values, found)[0], 0.0, atol=1e-12)
    priors = {i: frame.prior for i, frame in enumerate(r.frames) if frame.prior is not None}
    assert bool(priors) == guided
    for i, prior in priors.items():
        scale, shift = affine_of_native(found.atCal3_S2(A(i)))
        assert unit * scale == pytest.approx(prior.scale, abs=0.3 * prior.scale_std)
        assert shift == pytest.approx(prior.shift, abs=0.3 * prior.shift_std)


def test_poses_that_are_fitted_to_a_rolling_shutter_are_nearly_its_minimum() -> None:
    r = rolling_result()
    assert r.shutter is not None
    assert r.shutter.recorded
    # The same errors have other derivatives at the poses of the recorded images than at those of the middle row.
    assert 0.1 < np.abs(moved_in_deviations(r)).max() < 0.5
    assert 50.0 < np.abs(moved_in_deviations(replace(r, rolled=None))).max() < 120.0


def moved_in_deviations(r: Reconstruction) -> np.ndarray:
    """(frames - 1, 6) by how many standard deviations the optimiser moves the poses, in the same unit."""
    graph, values = factor_graph(r)
    found = optimized(graph, values)
    return moved(values, found, unit_of(found, r))[1:] / standard_deviations(r)[1:]


def test_a_longer_result_is_its_minimum_and_as_certain() -> None:
    r = longer_result()
    graph, values = factor_graph(r)
    found = optimized(graph, values)
    expected = standard_deviations(r)[1:]
    assert (np.abs(moved(values, found, unit_of(found, r))[1:]) < 0.02 * expected).all()
    ratio = np.sqrt(np.diag(pose_covariance(graph, values, r))).reshape(-1, 6)[1:] / expected
    assert 0.99 < ratio.min() <= ratio.max() < 1.03
    independent, _ = factor_graph(replace(r, noise=replace(r.noise, track=np.zeros(len(r.points)))))
    ratio = np.sqrt(np.diag(pose_covariance(independent, values, r))).reshape(-1, 6)[1:] / expected
    assert 0.8 < np.median(ratio) < 0.97


@pytest.mark.parametrize(("motion", "least"), [("dolly", 0.97), ("handheld", 0.98), ("truck", 0.98)])
def test_the_prior_makes_it_hardly_more_certain_than_the_result(motion: Motion, least: float) -> None:
    r = result(motion)
    graph, values = factor_graph(r)
    ratio = np.sqrt(np.diag(pose_covariance(graph, values, r))).reshape(-1, 6)[1:] / standard_deviations(r)[1:]
    assert least < ratio.min() <= ratio.max() < 1.002
    assert np.median(ratio) > 0.99


def test_a_result_that_was_read_back_has_robust_observations_and_no_prior(tmp_path: Path) -> None:
    r = result("dolly")
    r.write(tmp_path)
    back = read_result(tmp_path)
    graph, values = factor_graph(back)
    assert set(values.keys()) == {X(i) for i in range(FRAMES)} | {L(j) for j in r.track_ids.tolist()} | {T(0)}
    projections = factors_of(graph, *PROJECTIONS)
    assert len(projections) == len(r.observation_xy)
    assert all(isinstance(factor.noiseModel(), gtsam.noiseModel.Robust) for factor in projections)
    found = optimized(graph, values)
    steps = np.abs(moved(values, found, unit_of(found, back))[1:]) / standard_deviations(r)[1:]
    assert 0.1 < steps.max() < 1.0


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
    points = np.array([found.atPoint3(L(j)) for j in r.track_ids])
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
    projections = factors_of(graph, *PROJECTIONS)
    assert len(projections) == len(r.registered) * len(r.points) < len(r.observation_xy)
    assert max(np.linalg.norm(factor.unwhitenedError(values)) for factor in projections) < 2e-9
    assert not values.exists(X(16))
    straight = replace(r, camera=pycolmap.Camera(model="PINHOLE", width=640, height=480, params=r.camera.params[:4]))
    projections = factors_of(factor_graph(straight)[0], *PROJECTIONS)
    assert max(np.linalg.norm(factor.unwhitenedError(values)) for factor in projections) > 0.3
