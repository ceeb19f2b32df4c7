"""Factors of the caller: what is refused, what becomes of them when keyframes are constant, and the unit of length."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, B, L, P, V, X

from factorsfm import InputError
from factorsfm.graph.added_factors import NOTHING_ADDED, AddedFactors, condensed, error_of, held_prior
from factorsfm.graph.factor_checks import checked_factors
from factorsfm.graph.factors import HELD, NATIVE_BY_AFFINE, camera_from_pose, native_affine, native_affine_noise
from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.graph.keys import part_of
from factorsfm.graph.unit_of_length import unit_of_length

FRAMES = 6
NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
UNIT_3 = gtsam.noiseModel.Unit.Create(3)


class Contents:
    """Poses on a bent path, two landmarks, one affine."""

    def __init__(self, unit=1.0, frames=FRAMES):
        rng = np.random.default_rng(0)
        self.poses = [
            gtsam.Pose3(gtsam.Rot3.RzRyRx(*(0.1 * rng.normal(size=3))), unit * np.array([0.3 * k, 0.1 * k * k, 0.0]))
            for k in range(frames)
        ]
        self.points = {7: unit * np.array([0.2, 0.1, 4.0]), 9: unit * np.array([-0.5, 0.3, 5.0])}

    def pose(self, frame):
        return camera_from_pose(self.poses[frame]) if frame < len(self.poses) else None

    def affine(self, frame):
        return (1.2, 0.1) if frame == 0 else None

    def landmark(self, track):
        return self.points.get(track)


def test_constants_that_contradict_each_other_are_no_error_of_what_is_condensed():
    """Of two measurements of one variable, 60 standard deviations apart, no value of it can meet more than the mean."""

    def along(x):
        return gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0]))

    graph = graph_of(*(gtsam.BetweenFactorPose3(X(k), P(1), along(0.6 * k), NOISE) for k in range(2)))
    graph.add(gtsam.BetweenFactorPose3(P(1), P(0), along(0.0), gtsam.noiseModel.Isotropic.Sigma(6, 0.01 / 2**0.5)))
    graph.add(gtsam.BetweenFactorPose3(P(0), X(2), along(0.0), NOISE))
    constants = gtsam.Values()
    for k in range(2):
        constants.insert(X(k), gtsam.Pose3())
    own = values_of(p0=along(0.3))
    own.insert(P(1), along(0.3))
    short = condensed(AddedFactors.of(range(4), graph, own), {X(2)}, constants).graph()
    (linear,) = (f for f in map(short.at, range(short.size())) if isinstance(f, gtsam.LinearContainerFactor))
    assert 2.0 * linear.error(values_of(p0=along(0.3))) == pytest.approx(2 * 30.0**2, rel=1e-3)
    for x, expected in ((0.3, 0.0), (0.31, 1.0)):  # with the noise of the mean and that of the last step
        assert error_of(linear, values_of(p0=along(x))) == pytest.approx(expected, abs=1e-3)


def graph_of(*factors):
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def values_of(**values):
    result = gtsam.Values()
    for key, value in values.items():
        result.insert({"p0": P(0), "v0": V(0), "b0": B(0), "x0": X(0)}[key], value)
    return result


def checked(graph, values=None, earlier=(), first=0):
    names = {name for added in earlier for name in added.own_names}
    values = values if values is not None else gtsam.Values()
    return checked_factors(graph, values, Contents(), list(earlier), names, first)


def between(i, j, truth, noise=NOISE):
    return gtsam.BetweenFactorPose3(X(i), X(j), truth.poses[i].between(truth.poses[j]), noise)


# --- what is refused --------------------------------------------------------------------------------------------


def test_factors_are_numbered_and_cross_as_text_without_loss():
    truth = Contents()
    graph = graph_of(between(0, 1, truth), gtsam.PriorFactorPoint3(L(7), np.array([1 / 3, 2 / 7, 4.0]), UNIT_3))
    graph.add(gtsam.BetweenFactorPose3(X(2), P(0), gtsam.Pose3(), NOISE))
    added = checked(graph, values_of(p0=truth.poses[3]), first=5)
    assert added.numbers == (5, 6, 7)
    assert added.graph().equals(graph, 0.0)
    assert added.values().equals(values_of(p0=truth.poses[3]), 0.0)
    assert (added.frames, added.tracks) == ({0, 1, 2}, {7})
    assert NOTHING_ADDED.graph().size() == NOTHING_ADDED.values().size() == 0


CUSTOM = gtsam.CustomFactor(NOISE, [X(0)], lambda this, values, jacobians: np.zeros(6))
REFUSED = {
    "types": (None, gtsam.Values(), "NoneType and Values; gtsam.NonlinearFactorGraph and gtsam.Values are expected"),
    "callback": (graph_of(CUSTOM), None, "factor 0 is a Python callback"),
    "no text": (
        graph_of(gtsam.PoseRotationPrior3D(X(0), gtsam.Pose3(), UNIT_3)), None, "PoseRotationPrior3D, cannot be seria",
    ),
    "pose": (graph_of(gtsam.PriorFactorPose3(X(6), gtsam.Pose3(), NOISE)), None, "unknown key x6: it is not a key"),
    "landmark": (graph_of(gtsam.PriorFactorPoint3(L(8), np.zeros(3), UNIT_3)), None, "l8: it is not a landmark"),
    "affine": (
        graph_of(gtsam.PriorFactorCal3_S2(A(1), gtsam.Cal3_S2(), gtsam.noiseModel.Unit.Create(5))), None,
        "a1: it is not a keyframe with a depth map",
    ),
    "own": (graph_of(gtsam.PriorFactorVector(V(1), np.zeros(3), UNIT_3)), None, "unknown key v1: no value is given"),
    "taken": (graph_of(), values_of(x0=gtsam.Pose3()), "a value is given for x0; variables with the letters"),
    "unnamed": (graph_of(), values_of(v0=np.zeros(3)), "indeterminate: no factor names v0"),
    "open": (
        graph_of(gtsam.RangeFactorPose3(X(0), P(0), 1.0, gtsam.noiseModel.Unit.Create(1))),
        values_of(p0=gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 1.0]))), "indeterminate: the factors do not determi",
    ),
    "nan": (
        graph_of(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan)), NOISE)), None,
        "factor 0, a PriorFactorPose3, holds a number that is not finite",
    ),
    "overflow": (
        graph_of(gtsam.GPSFactor(X(0), np.full(3, 1e300), UNIT_3)), None,
        "factor 0, a GPSFactor, is not finite at the given values",
    ),
    "infinity": (
        graph_of(gtsam.GPSFactor(X(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, np.inf))), None,
        "factor 0, a GPSFactor, holds a number that is not finite",
    ),
    "another type": (
        graph_of(gtsam.PriorFactorPoint3(X(0), np.zeros(3), UNIT_3)), None,
        'factor 0, a PriorFactorPoint3, cannot be evaluated: .* key "x0", type stored in Values is .*Pose3',
    ),
    "own of another type": (
        graph_of(gtsam.PriorFactorPose3(P(0), gtsam.Pose3(), NOISE)), values_of(p0=np.zeros(3)),
        'factor 0, a PriorFactorPose3, cannot be evaluated: .* key "p0"',
    ),
    "constraint": (
        graph_of(gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(), gtsam.noiseModel.Constrained.All(6))), None,
        "factor 0, a BetweenFactorPose3, has a standard deviation of zero; a small one is expected",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("graph", "values", "message"), REFUSED.values(), ids=REFUSED)
def test_what_the_graph_cannot_take_is_refused(graph, values, message):
    with pytest.raises(InputError, match=message):
        checked(graph, values)


def test_a_variable_is_added_once_and_known_from_then_on():
    prior = gtsam.PriorFactorVector(V(0), np.zeros(3), UNIT_3)
    first = checked(graph_of(prior), values_of(v0=np.zeros(3)))
    with pytest.raises(InputError, match="a value is given for v0, which was added before"):
        checked(graph_of(prior), values_of(v0=np.ones(3)), [first])
    assert checked(graph_of(prior), None, [first], 1).numbers == (1,)
    with pytest.raises(InputError, match="unknown key v0: all keyframes that it has to do with have become constant"):
        checked_factors(graph_of(prior), gtsam.Values(), Contents(), [], {V(0)}, 1)


# --- what becomes constant --------------------------------------------------------------------------------------


def chain(truth):
    """Poses beside each other, and two variables of the caller's: one beside the early ones, one beside all."""
    graph = graph_of(*(between(k, k + 1, truth) for k in range(FRAMES - 1)))
    for k in range(3):
        graph.add(gtsam.BetweenFactorPose3(X(k), P(0), truth.poses[k].between(truth.poses[2]), NOISE))
    for k in range(FRAMES):
        graph.add(gtsam.BetweenFactorPose3(X(k), P(1), truth.poses[k].between(truth.poses[4]), NOISE))
    graph.add(gtsam.BetweenFactorPose3(P(0), P(1), truth.poses[2].between(truth.poses[4]), NOISE))
    own = gtsam.Values()
    own.insert(P(0), truth.poses[2])
    own.insert(P(1), truth.poses[4])
    return AddedFactors.of(range(graph.size()), graph, own)


def values_at(truth, frames):
    values = gtsam.Values()
    for k in frames:
        values.insert(X(k), truth.poses[k])
    return values


def test_factors_on_constants_are_condensed_and_say_the_same():
    truth = Contents()
    added, constants, free = chain(truth), values_at(truth, range(4)), {X(4), X(5)}
    short = condensed(added, free, constants)
    kinds = [type(short.graph().at(k)).__name__ for k in range(short.graph().size())]
    assert kinds.count("LinearContainerFactor") == 1
    assert len(kinds) == 5  # two between poses, two beside the free poses, and what the others have become
    assert set(short.values().keys()) == {P(1)}
    assert set(short.numbers).isdisjoint(set(added.numbers) - {3, 4, 12, 13})
    assert len(set(short.numbers)) == len(short.numbers)

    def solved(factors, *held):
        """Free poses and P(1), with a wrong measurement that bends the solution."""
        graph, values = factors.graph(), values_at(truth, (4, 5))
        values.insert(factors.values())
        for frames in held:
            values.insert(part_of(frames, set(frames.keys()) - set(values.keys())))
            for key in list(frames.keys()):
                graph.add(held_prior(key, frames))
        if not values.exists(X(3)):
            values.insert(X(3), truth.poses[3])
            graph.add(held_prior(X(3), constants))
        graph.add(gtsam.PriorFactorPose3(X(5), truth.poses[5].retract(np.full(6, 0.01)), NOISE))
        found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return [found.atPose3(key) for key in (X(4), X(5), P(1))]

    for whole, part in zip(solved(added, constants), solved(short), strict=True):
        moved = np.linalg.norm(whole.localCoordinates(part))
        assert moved < 2e-6  # the condensed part is linear, the bend 0.01
    assert condensed(short, free, constants) is short


def test_what_no_free_variable_has_to_do_with_is_forgotten():
    truth = Contents()
    graph = graph_of(between(0, 1, truth), between(1, 2, truth))
    added = AddedFactors.of(range(2), graph, gtsam.Values())
    assert condensed(added, {X(5)}, values_at(truth, range(3))) == NOTHING_ADDED


# --- the unit of length -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.01, 0.9, 30.0])
def test_the_unit_of_length_is_that_of_the_factors(unit):
    truth = Contents(unit)
    graph = graph_of(*(between(k, k + 1, truth, gtsam.noiseModel.Isotropic.Sigma(6, 0.01 * unit)) for k in range(5)))
    found, std = unit_of_length(AddedFactors.of(range(5), graph, gtsam.Values()), Contents())
    assert found == pytest.approx(unit, rel=1e-6)
    steps = np.linalg.norm([truth.poses[k].between(truth.poses[k + 1]).translation() for k in range(5)], axis=1)
    assert std == pytest.approx(0.01 * unit / np.sqrt((steps**2).sum()), rel=1e-3)


def test_positions_in_another_world_determine_no_unit():
    """As fixes are, whose axes are not those of the first camera; noise makes a unit as uncertain as it is large."""
    truth, sigma = Contents(5.0), gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    world = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.2, 1.0), np.array([412.0, -77.0, 30.0]))
    fixes = [world.compose(pose).translation() for pose in truth.poses]
    graph = graph_of(*(gtsam.GPSFactor(X(k), fix, sigma) for k, fix in enumerate(fixes)))
    assert unit_of_length(AddedFactors.of(range(FRAMES), graph, gtsam.Values()), Contents()) == (1.0, np.inf)
    noisy = [pose.translation() + 0.1 * (-1.0) ** k for k, pose in enumerate(truth.poses)]
    graph = graph_of(*(gtsam.GPSFactor(X(k), place, sigma) for k, place in enumerate(noisy)))
    found, std = unit_of_length(AddedFactors.of(range(FRAMES), graph, gtsam.Values()), Contents())
    size = np.linalg.norm([pose.translation() for pose in truth.poses])
    assert found == pytest.approx(5.0, abs=15 * std)
    assert std == pytest.approx(0.1 / size, rel=0.2)


def test_variables_of_the_caller_follow_the_unit():
    """A point of the caller's own at known ranges of all poses, which begins in the wrong unit."""
    truth, place, sigma = Contents(5.0), np.array([20.0, 15.0, 2.0]), gtsam.noiseModel.Isotropic.Sigma(1, 0.01)
    graph = graph_of()
    for k in range(FRAMES):
        distance = float(np.linalg.norm(truth.poses[k].translation() - place))
        graph.add(gtsam.RangeFactor3D(X(k), P(0), distance, sigma))
        graph.add(gtsam.PriorFactorPoint3(P(0), place, gtsam.noiseModel.Isotropic.Sigma(3, 0.01)))
    own = gtsam.Values()
    own.insert(P(0), place + [0.05, 0.0, 0.1])
    assert unit_of_length(AddedFactors.of(range(12), graph, own), Contents())[0] == pytest.approx(5.0, rel=1e-4)


def test_rotations_and_landmarks_without_a_length_leave_the_unit_open():
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 3 + [1e3] * 3))
    truth = Contents(5.0)
    graph = graph_of(*(between(k, k + 1, truth, loose) for k in range(5)))
    assert unit_of_length(AddedFactors.of(range(5), graph, gtsam.Values()), Contents()) == (1.0, np.inf)


# --- a quadratic on poses ---------------------------------------------------------------------------------------


def test_the_quadratic_has_the_gradient_and_the_curvature_of_the_least_cost():
    """Own variables at their best for each pose; the cost is that of the factors off their truth."""
    truth, rng = Contents(), np.random.default_rng(1)
    off = [pose.retract(rng.normal(0, 1e-3, 6)) for pose in truth.poses]
    points = np.array([truth.points[7] + [1e-3, 0, 0]])
    graph = chain(truth).graph()
    graph.add(gtsam.RangeFactor3D(X(1), L(7), 4.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.01)))
    graph.add(gtsam.PriorFactorCal3_S2(A(2), native_affine(1.1, 0.2), native_affine_noise(0.02, 0.05)))
    added = AddedFactors.of(range(graph.size()), graph, chain(truth).values())
    on_poses = FactorsOnPoses(added, truth, range(FRAMES), [7], [2, 4])
    assert on_poses.loose == []

    def at(step):
        poses = [pose.retract(step[6 * k : 6 * k + 6]) for k, pose in enumerate(off)]
        cameras = [camera_from_pose(pose) for pose in poses]
        affines = np.array([[1.0, 0.1], [0.7, 0.0]]) + step[-4:].reshape(2, 2)
        return np.array([r for r, _ in cameras]), np.array([t for _, t in cameras]), points + step[-7:-4], affines

    size, step = 6 * FRAMES + 3 + 4, 1e-5
    information, gradient = on_poses.quadratic(*at(np.zeros(size)))
    numeric = np.array(
        [(on_poses.cost(*at(step * e)) - on_poses.cost(*at(-step * e))) / (2 * step) for e in np.eye(size)]
    )
    np.testing.assert_allclose(gradient, numeric, atol=1e-4 * np.abs(numeric).max())
    np.testing.assert_allclose(information, information.T, atol=1e-6 * np.abs(information).max())
    direction = rng.normal(size=size)
    along = [on_poses.cost(*at(s * direction)) for s in (-1e-3, 0.0, 1e-3)]
    curvature = (along[0] - 2 * along[1] + along[2]) / 1e-6
    assert direction @ information @ direction == pytest.approx(curvature, rel=2e-2)
    assert information[-4, -4] == pytest.approx(0.02**-2)
    assert gradient[-4:] == pytest.approx([-0.1 / 0.02**2, -0.1 / 0.05**2, 0.0, 0.0])
    names = dict(on_poses.errors(*at(np.zeros(size))))
    assert names["PriorFactorCal3_S2 on a2"] == pytest.approx(np.sqrt((5.0**2 + 2.0**2) / 5), rel=1e-6)
    chosen = on_poses.of([graph.size() - 1])
    assert chosen.errors(*at(np.zeros(size))) == [("PriorFactorCal3_S2 on a2", pytest.approx(np.sqrt(29 / 5)))]
    assert not chosen.quadratic(*at(np.zeros(size)))[0][:-4].any()
    assert FactorsOnPoses(added, truth, range(FRAMES), [7], [4]).loose == ["a2"]
    assert names["BetweenFactorPose3 on x0, x1"] == pytest.approx(
        np.sqrt(2 * graph.at(0).error(values_of_poses(off)) / 6), rel=1e-6
    )


def values_of_poses(poses):
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    return values


def test_held_priors_hold():
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(L(0), np.ones(3))
    values.insert(A(0), gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.2, 0.0))
    for key in (X(0), L(0), A(0)):
        graph = graph_of(held_prior(key, values))
        covariance = gtsam.Marginals(graph, values).marginalCovariance(key)
        by = NATIVE_BY_AFFINE if key == A(0) else np.eye(len(covariance))  # the scale of an affine is what is held
        held = np.linalg.pinv(by) @ covariance @ np.linalg.pinv(by).T
        np.testing.assert_allclose(np.sqrt(np.diag(held)), HELD, rtol=1e-6)
