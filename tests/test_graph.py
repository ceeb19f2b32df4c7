from dataclasses import replace

import numpy as np
import pytest
from estimation_problems import angles_between, make_problem, rotation_matrices

from factorsfm.graph import DepthMeasurements, FactorGraph, Keyframe

SIGMA = 0.25  # pixels
NO_IDS, NO_POINTS = np.zeros(0, np.int64), np.zeros((0, 3))


class Shot:
    """Keyframes of a synthetic shot, with a first guess away from the truth."""

    def __init__(self, motion="handheld", *, noise_px=0.0, affine=(1.4, 0.2), seed=0):
        self.problem = make_problem(motion, frames=8, points=80, parallax=0.1, noise_px=noise_px, seed=seed)
        self.affine = affine
        rng = np.random.default_rng(seed)
        n = len(self.problem.points)
        self.guess = self.problem.points * np.exp(0.05 * rng.standard_normal((n, 1)))
        self.turn = rotation_matrices(0.002 * rng.standard_normal((8, 3)))
        self.move = 0.005 * rng.standard_normal((8, 3))
        self.turn[0], self.move[0] = np.eye(3), 0.0
        self.half = np.arange(n // 2)  # known from the first keyframe on; the rest appears in the third

    def depth(self, frame, ids):
        """The prior, exact up to its affine, with a first guess of the affine that is off."""
        scale, shift = self.affine
        value = scale / self.problem.depth(frame, ids) + shift
        return DepthMeasurements(ids, value, np.full(len(ids), 0.02), (1.2 * scale, shift + 0.1))

    def keyframe(self, frame, *, depth=True, count=None):
        ids, xy = self.problem.of_frame(frame)
        if count is not None:
            ids, xy = ids[:count], xy[:count]
        truth = self.problem.truth
        return Keyframe(
            frame,
            self.turn[frame] @ truth.rotation[frame],
            truth.translation[frame] + self.move[frame],
            ids,
            xy,
            self.depth(frame, ids) if depth else None,
        )

    def update(self, graph, frame, **kwargs):
        """Keyframes 0 and 1 see half of the points; with the third the others appear, with earlier observations."""
        if frame < 2:
            keyframe = self.keyframe(frame, count=len(self.half), **kwargs)
            new = self.half if frame == 0 else NO_IDS
            return graph.update(keyframe, new, self.guess[new], [])
        rest = np.arange(len(self.half), len(self.guess))
        new, earlier = NO_IDS, []
        if frame == 2:
            new = rest
            for before in (0, 1):
                ids, xy = self.problem.of_frame(before)
                earlier.append((before, ids[rest], xy[rest]))
        return graph.update(self.keyframe(frame, **kwargs), new, self.guess[new], earlier)

    def run(self, **kwargs):
        graph = FactorGraph(self.problem.focal, SIGMA)
        for frame in range(8):
            result = self.update(graph, frame, **kwargs)
            assert result.committed, result.reason
        return graph


def unit_of(graph, shot):
    ids, points = graph.points()
    return np.median(np.linalg.norm(points, axis=1) / np.linalg.norm(shot.problem.points[ids], axis=1))


def assert_truth(graph, shot, *, angle_rad, distance, depth):
    """Poses, points and affines against the truth, in the truth's unit."""
    unit, truth = unit_of(graph, shot), shot.problem.truth
    poses = graph.poses()
    assert list(poses) == graph.keyframes
    for position, (rotation, translation) in poses.items():
        assert angles_between(rotation[None], truth.rotation[position][None])[0] < angle_rad
        assert np.linalg.norm(translation / unit - truth.translation[position]) < distance
    ids, points = graph.points()
    np.testing.assert_array_equal(ids, np.arange(len(shot.problem.points)))
    length = np.linalg.norm(shot.problem.points, axis=1)
    relative = np.linalg.norm(points / unit - shot.problem.points, axis=1) / length
    assert np.median(relative) < depth


def assert_same(graph, other, tolerance):
    assert graph.keyframes == other.keyframes
    np.testing.assert_array_equal(graph.landmarks, other.landmarks)
    np.testing.assert_allclose(graph.points()[1], other.points()[1], rtol=tolerance, atol=tolerance)
    for position, (rotation, translation) in graph.poses().items():
        np.testing.assert_allclose(rotation, other.poses()[position][0], atol=tolerance)
        np.testing.assert_allclose(translation, other.poses()[position][1], atol=tolerance)
        assert graph.affine(position) == pytest.approx(other.affine(position), abs=tolerance)


# --- convergence ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["truck", "handheld", "dolly"])
def test_exact_observations_lead_to_the_truth(motion):
    shot = Shot(motion)
    graph = shot.run()
    assert_truth(graph, shot, angle_rad=2e-4, distance=5e-4, depth=2e-3)
    unit = unit_of(graph, shot)
    for position in graph.keyframes:
        scale, shift = graph.affine(position)
        assert scale / unit == pytest.approx(shot.affine[0], rel=0.02)
        assert shift == pytest.approx(shot.affine[1], abs=0.02)


def test_without_depth_the_geometry_alone_converges():
    shot = Shot("truck")
    graph = shot.run(depth=False)
    assert_truth(graph, shot, angle_rad=2e-4, distance=1e-3, depth=5e-3)
    assert all(graph.affine(position) is None for position in graph.keyframes)


def test_noise_costs_what_it_should():
    shot = Shot("truck", noise_px=SIGMA)
    assert_truth(shot.run(), shot, angle_rad=2e-3, distance=0.01, depth=0.03)


def test_outliers_are_tolerated():
    shot = Shot("truck")
    shot.problem.observations.xy[::23] += 0.02  # 12 pixels
    assert_truth(shot.run(), shot, angle_rad=1e-3, distance=5e-3, depth=0.02)


def test_a_prior_that_comes_later():
    shot = Shot("truck")
    graph = FactorGraph(shot.problem.focal, SIGMA)
    for frame in range(8):
        assert shot.update(graph, frame, depth=frame in (3, 6)).committed
    assert [graph.affine(k) is not None for k in range(8)] == [k in (3, 6) for k in range(8)]
    assert_truth(graph, shot, angle_rad=2e-4, distance=1e-3, depth=5e-3)


# --- what the accessors say -------------------------------------------------------------------------------------


def test_an_empty_graph():
    graph = FactorGraph(600.0, SIGMA)
    assert graph.poses() == {}
    ids, points = graph.points()
    assert len(ids) == 0
    assert points.shape == (0, 3)
    assert graph.affine(0) is None


def test_points_come_in_the_order_of_their_ids():
    shot = Shot("truck")
    graph = FactorGraph(shot.problem.focal, SIGMA)
    keyframe = shot.keyframe(0, depth=False)
    descending = replace(keyframe, ids=keyframe.ids[::-1] * 1000 + 5, xy=keyframe.xy[::-1])
    assert graph.update(descending, descending.ids, shot.problem.points[::-1], []).committed
    ids, points = graph.points()
    np.testing.assert_array_equal(ids, np.arange(len(ids)) * 1000 + 5)
    np.testing.assert_allclose(points, shot.problem.points, rtol=1e-6, atol=1e-6)


# --- transactions -----------------------------------------------------------------------------------------------


def garbage_pose(keyframe):
    return replace(keyframe, rotation=rotation_matrices([0.0, np.pi, 0.0])[0] @ keyframe.rotation)


def mirrored_depth(keyframe):
    """Near and far swapped, and believed to be exact."""
    d = keyframe.depth
    value = 3.0 - d.inverse_depth
    return replace(keyframe, depth=DepthMeasurements(d.ids, value, np.full(len(value), 1e-3), (0.5, value.mean())))


def wrong_tracks(keyframe):
    return replace(keyframe, xy=np.random.default_rng(0).permutation(keyframe.xy), depth=None)


def one_observation(keyframe):
    return replace(keyframe, ids=keyframe.ids[:1], xy=keyframe.xy[:1], depth=None)


def no_observations(keyframe):
    return replace(keyframe, ids=NO_IDS, xy=np.zeros((0, 2)), depth=None)


def not_finite(keyframe):
    return replace(keyframe, translation=np.full(3, np.nan))


def unknown_landmark(keyframe):
    return replace(keyframe, ids=np.append(keyframe.ids[:-1], 9999), depth=None)


def taken_position(keyframe):
    return replace(keyframe, position=1)


@pytest.mark.parametrize(
    "spoil",
    [
        garbage_pose,
        mirrored_depth,
        wrong_tracks,
        one_observation,
        no_observations,
        not_finite,
        unknown_landmark,
        taken_position,
    ],
)
def test_a_bad_update_is_rolled_back(spoil):
    shot = Shot("handheld", noise_px=0.1)
    graph, untouched = FactorGraph(shot.problem.focal, SIGMA), FactorGraph(shot.problem.focal, SIGMA)
    for frame in range(8):
        if frame == 4:
            before = graph.poses()
            result = graph.update(spoil(shot.keyframe(frame)), NO_IDS, NO_POINTS, [])
            assert not result.committed
            assert len(result.reason) > 10
            assert graph.keyframes == [0, 1, 2, 3]
            for position, (rotation, translation) in graph.poses().items():
                np.testing.assert_array_equal(rotation, before[position][0])
                np.testing.assert_array_equal(translation, before[position][1])
        assert shot.update(graph, frame).committed
        assert shot.update(untouched, frame).committed
    assert_same(graph, untouched, 1e-9)


def test_a_bad_first_update_is_rolled_back():
    shot = Shot("truck")
    graph = FactorGraph(shot.problem.focal, SIGMA)
    keyframe = shot.keyframe(0)
    assert not graph.update(not_finite(keyframe), keyframe.ids, shot.guess, []).committed
    assert graph.keyframes == []
    assert len(graph.landmarks) == 0
    for frame in range(8):
        assert shot.update(graph, frame).committed
    assert_same(graph, shot.run(), 1e-9)


def test_the_reasons_tell_what_happened():
    shot = Shot("truck")
    graph = FactorGraph(shot.problem.focal, SIGMA)
    for frame in range(4):
        shot.update(graph, frame)
    keyframe = shot.keyframe(4)
    assert "mirrored" in graph.update(mirrored_depth(keyframe), NO_IDS, NO_POINTS, []).reason
    assert "indeterminate" in graph.update(one_observation(keyframe), NO_IDS, NO_POINTS, []).reason
    assert "pixels" in graph.update(wrong_tracks(keyframe), NO_IDS, NO_POINTS, []).reason
