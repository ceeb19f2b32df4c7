"""A result as one linear factor: the same as the full graph for what is asked of its poses."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factorsfm import InputError, Reconstruction, condensed_factor, factor_graph
from factorsfm.graph.explicit_graph import measurements
from tests.exact_result import build
from tests.graph.results import longer_result, result, size_motion

NEXT_TO_NOTHING = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
ORDER = "klatx"


def eliminated(r: Reconstruction, kept: gtsam.Values) -> np.ndarray:
    """Augmented information of some poses, as GTSAM eliminates the rest."""
    graph, values = measurements(r)
    ordering = gtsam.Ordering()
    others = set(values.keys()) - set(kept.keys())
    for key in sorted(others, key=lambda key: (ORDER.index(chr(gtsam.Symbol(key).chr())), key)):
        ordering.push_back(key)
    return gtsam.HessianFactor(graph.linearize(values).eliminatePartialMultifrontal(ordering)[1]).augmentedInformation()


@pytest.mark.parametrize("frames", [None, [39, 0, 7]])
def test_it_is_what_is_left_when_gtsam_eliminates_everything_else(frames: list[int] | None) -> None:
    assert_same(longer_result(), frames)


def test_depth_is_eliminated_alike() -> None:
    assert_same(result("dolly"), None)


def test_a_camera_that_only_turns_stays_where_it_is() -> None:
    r = result("rotation")
    factor, _ = condensed_factor(r, [0, 3, 7])
    held = factor.factor().information()
    held[:6, :6] += 1e14 * np.eye(6)
    size = np.sqrt(np.diag(held))
    std = np.sqrt(np.diag(np.linalg.inv(held / np.outer(size, size)))) / size
    for k, i in ((1, 3), (2, 7)):
        expected = np.sqrt(np.diag(r.frames[i].covariance))[:3]
        np.testing.assert_allclose(std[6 * k : 6 * k + 3], expected, rtol=0.05)
        np.testing.assert_allclose(std[6 * k + 3 : 6 * k + 6], 1e-6, rtol=0.1)


def assert_same(r: Reconstruction, frames: list[int] | None) -> None:
    factor, at = condensed_factor(r, frames)
    assert list(factor.keys()) == [X(i) for i in sorted(frames or range(len(r.frames)))]
    expected = eliminated(r, at)
    size = np.sqrt(np.diag(expected))
    found = factor.factor().augmentedInformation()
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=1e-9)


def test_a_measurement_has_the_same_effect_as_in_the_full_graph() -> None:
    r = longer_result()
    graph, values = factor_graph(r)
    factor, at = condensed_factor(r)
    condensed = gtsam.NonlinearFactorGraph()
    condensed.add(factor)
    condensed.add(gtsam.PriorFactorPose3(X(0), at.atPose3(X(0)), NEXT_TO_NOTHING))
    last = np.sqrt(np.diag(r.frames[-1].covariance))
    off = np.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0]) * 3.0 * last
    measured = at.atPose3(X(0)).between(at.atPose3(X(39)).retract(off))
    for each in (graph, condensed):
        each.add(gtsam.BetweenFactorPose3(X(0), X(39), measured, gtsam.noiseModel.Diagonal.Sigmas(last)))
    expected = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = gtsam.LevenbergMarquardtOptimizer(condensed, at).optimize()
    std = np.array([np.sqrt(np.diag(frame.covariance)) for frame in r.frames[1:]])
    step = np.array([at.atPose3(X(i)).localCoordinates(found.atPose3(X(i))) for i in range(1, 40)]) / std
    wrong = np.array([expected.atPose3(X(i)).localCoordinates(found.atPose3(X(i))) for i in range(1, 40)]) / std
    assert np.abs(step).max() > 1.0
    assert np.abs(wrong).max() < 0.05


def test_its_poses_are_as_certain_as_those_of_the_result() -> None:
    for r, least in ((longer_result(), 0.98), (result("dolly"), 0.96), (result("handheld"), 0.96)):
        factor, at = condensed_factor(r)
        keys = list(at.keys())
        held = factor.factor().information()
        held[:6, :6] += 1e12 * np.eye(6)
        size = np.sqrt(np.diag(held))
        covariance = np.linalg.inv(held / np.outer(size, size)) / np.outer(size, size)
        # The unit is open here: errors are compared in the directions in which it does not move a pose.
        for k, motion in list(enumerate(size_motion(at, keys).reshape(-1, 6)))[1:]:
            across = np.linalg.svd(motion[None])[2][1:]
            own = across @ covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] @ across.T
            said = across @ r.frames[k].covariance @ across.T
            ratio = np.sqrt(np.diag(own) / np.diag(said))
            assert least < ratio.min() <= ratio.max() < 1.01


def test_position_and_orientation_of_the_whole_are_open() -> None:
    r = result("handheld")
    factor, at = condensed_factor(r)
    information = factor.factor().information()
    turned = np.concatenate([at.atPose3(key).inverse().AdjointMap() for key in list(at.keys())])
    scale = np.concatenate([np.ones(3), np.full(3, np.median(np.linalg.norm(r.points, axis=1)))])
    gauge = np.diag(turned.T @ information @ turned) * scale**2
    assert (gauge < 1.0).all()
    lengthened = size_motion(at, list(at.keys()))
    assert lengthened @ information @ lengthened < 100.0
    assert np.linalg.eigvalsh(information)[7] > 1e5


def test_frames_that_are_not_there_are_named() -> None:
    with pytest.raises(InputError, match=r"frames must be some of the 5 registered ones, not \[16, 99\]"):
        condensed_factor(build(), [10, 99, 16])
    with pytest.raises(InputError, match=r"not \[\]"):
        condensed_factor(build(), [])


def test_a_result_without_noise_is_condensed_with_the_weights_of_the_kernel() -> None:
    assert_same(replace(longer_result(), noise=None), None)
