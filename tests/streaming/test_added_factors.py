"""Factors that a user adds to a running stream: taken as a whole, kept through everything, and heard by the polish."""

import itertools
import os
import signal
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, L, P, X

from factorsfm import Control, Frame, InputError, KnownDistance, Stream, read_result
from factorsfm.graph.factors import VIRTUAL_BASELINE, native_affine_noise
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot
from tests.rendered import Maps, rendered, simulated_maps

METRES = 5.3  # in a unit of the rendered shots
POSE_NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-3, 1e-3 * METRES], 3))
LONG = 40


@cache
def long_shot() -> RenderedShot:
    return render_shot("truck", LONG, 320, 180)


def metric(shot: RenderedShot, k: int) -> gtsam.Pose3:
    """True pose in metres."""
    pose = shot.cam_from_world[k].inverse()
    return gtsam.Pose3(gtsam.Rot3(pose.rotation.matrix()), METRES * pose.translation)


def odometry(shot: RenderedShot, frames: list[int]) -> gtsam.NonlinearFactorGraph:
    """How far the camera has come between successive frames."""
    graph = gtsam.NonlinearFactorGraph()
    for i, j in itertools.pairwise(frames):
        graph.add(gtsam.BetweenFactorPose3(X(i), X(j), metric(shot, i).between(metric(shot, j)), POSE_NOISE))
    return graph


def length_ratio(stream: Stream, shot: RenderedShot) -> float:
    """Lengths of the stream in metres."""
    centers = pose_arrays(stream.trajectory())[1]
    found, true = (
        np.linalg.norm(centers - centers[0], axis=1),
        [np.linalg.norm(metric(shot, 0).between(metric(shot, k)).translation()) for k in range(len(centers))],
    )
    return float(np.sum(found) / np.sum(true))


def run(stream: Stream, shot: RenderedShot, first: int = 0, every: int = 1) -> list[str]:
    """Push frames, odometry between the keyframes; the notes."""
    notes, last = [], max(stream.keyframes, default=0) if first else 0
    for k, image in list(enumerate(shot.images))[first:]:
        notes.append(stream.push(image, keyframe=k % every == 0).note)
        new = [i for i in stream.keyframes if i > last]
        if new:
            stream.add_factors(odometry(shot, [last, *new]), gtsam.Values())
            last = new[-1]
    return [note for note in notes if note]


@pytest.fixture
def stream():
    with Stream(rendered("truck").camera, depth=Maps(simulated_maps("truck"))) as stream:
        yield stream


def test_odometry_sets_the_unit_of_the_live_map_and_of_the_result(stream):
    shot = rendered("truck")
    notes = run(stream, shot)
    assert len(notes) == 1
    assert notes[0].startswith("the factors added set the unit of length: lengths are now ")
    assert length_ratio(stream, shot) == pytest.approx(1.0, abs=5e-3)
    graph, values = stream.graph()
    kinds = [type(graph.at(k)).__name__ for k in range(graph.size())]
    keyframes = list(stream.keyframes)
    assert kinds.count("BetweenFactorPose3") == len(keyframes) - 2  # the last one waits for another keyframe
    assert all(values.exists(X(k)) for k in keyframes)
    result = stream.finish()
    assert result.metric
    assert result.control is not None
    assert result.control.source == "factors"
    assert len(result.control.residuals) == len(keyframes) - 1
    assert 0.01 < max(r.sigmas for r in result.control.residuals) < 1.0
    centers = result.camera_centers()
    true = metric(shot, 0).between(metric(shot, 7)).translation()
    assert np.linalg.norm(centers[-1] - centers[0]) == pytest.approx(np.linalg.norm(true), rel=3e-3)
    assert any(note.startswith("Factors added: ") for note in result.notes)
    assert result.control.scale_std < 0.02


def test_a_long_shot_keeps_few_factors_and_says_of_all_of_them():
    shot = long_shot()
    with Stream(shot.camera) as stream:
        run(stream, shot, every=1)
        assert len(stream.keyframes) > 25
        assert length_ratio(stream, shot) == pytest.approx(1.0, abs=3e-3)
        graph, _ = stream.graph()
        kinds = [type(graph.at(k)).__name__ for k in range(graph.size())]
        assert kinds.count("BetweenFactorPose3") == 15  # those of the 16 keyframes that are solved for; the last waits
        assert len(stream.finish().control.residuals) == len(stream.keyframes) - 1


def test_a_pinned_landmark_stays_where_it_was_surveyed(stream):
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    stream.trajectory()
    _, values = stream.graph()
    track = next(gtsam.symbolIndex(key) for key in list(values.keys()) if gtsam.symbolChr(key) == ord("l"))
    place = 1.01 * values.atPoint3(L(track))
    prior = gtsam.NonlinearFactorGraph()
    prior.add(gtsam.PriorFactorPoint3(L(track), place, gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    stream.add_factors(prior, gtsam.Values())
    for image in shot.images[5:]:
        stream.push(image, keyframe=True)
    stream.trajectory()
    after = stream.graph()[1].atPoint3(L(track))
    np.testing.assert_allclose(after, place, atol=5e-4)
    assert np.linalg.norm(after - values.atPoint3(L(track))) > 5e-3
    result = stream.finish()
    found = result.points[np.flatnonzero(result.track_ids == track)]
    assert len(found) == 1
    np.testing.assert_allclose(found[0], place, atol=5e-3)


def test_variables_of_the_user_are_solved_for(stream):
    """A beacon at known places of three poses."""
    shot = rendered("truck")
    beacon = metric(shot, 3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, image in enumerate(shot.images):
        stream.push(image, keyframe=True)
        if k == 4:
            for i in (1, 3, 4):
                graph.add(gtsam.BetweenFactorPose3(X(i), P(0), metric(shot, i).between(beacon), POSE_NOISE))
            values.insert(P(0), gtsam.Pose3())
            stream.add_factors(graph, values)
    stream.trajectory()
    found = stream.graph()[1].atPose3(P(0))
    expected = metric(shot, 0).between(beacon)
    assert np.linalg.norm(expected.localCoordinates(found)) < 0.02


def test_they_survive_a_snapshot(tmp_path, stream):
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    stream.add_factors(odometry(shot, list(stream.keyframes)), gtsam.Values())
    stream.save(tmp_path / "waiting")
    stream.push(shot.images[5], keyframe=True)
    stream.trajectory()
    stream.save(tmp_path / "taken")
    unit = length_ratio(stream, shot)
    for name, first in (("waiting", 5), ("taken", 6)):
        with Stream.load(tmp_path / name, depth=Maps(simulated_maps("truck"))) as other:
            for image in shot.images[first:]:
                other.push(image, keyframe=True)
            other.trajectory()
            graph, _ = other.graph()
            kinds = [type(graph.at(k)).__name__ for k in range(graph.size())]
            assert kinds.count("BetweenFactorPose3") == 4
            assert length_ratio(other, shot) == pytest.approx(unit, rel=5e-3)
            assert len(other.finish().control.residuals) == 4


@pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
def test_they_survive_a_process_that_is_killed(stream):
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    stream.add_factors(odometry(shot, list(stream.keyframes)), gtsam.Values())
    stream.push(shot.images[5], keyframe=True)
    stream.trajectory()
    os.kill(stream._graph._process._popen.pid, signal.SIGKILL)
    for image in shot.images[6:]:
        stream.push(image, keyframe=True)
    stream.trajectory()
    graph, _ = stream.graph()
    kinds = [type(graph.at(k)).__name__ for k in range(graph.size())]
    assert kinds.count("BetweenFactorPose3") == 4
    assert length_ratio(stream, shot) == pytest.approx(1.0, abs=5e-3)


def test_what_contradicts_the_images_is_refused_as_a_whole_and_said(stream):
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    stream.trajectory()
    good, bad = odometry(shot, [0, 1]), gtsam.NonlinearFactorGraph()
    turned = gtsam.Pose3(gtsam.Rot3.Ry(2.5), np.zeros(3))
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    bad.push_back(good)
    bad.add(gtsam.BetweenFactorPose3(X(3), X(4), turned, tight))
    stream.add_factors(bad, gtsam.Values())
    stream.push(shot.images[5], keyframe=True)
    notes = [stream.push(image, keyframe=True).note for image in shot.images[6:]]
    stream.trajectory()
    assert any(note.startswith("the factors added are refused: ") for note in notes), notes
    graph, _ = stream.graph()
    assert "BetweenFactorPose3" not in [type(graph.at(k)).__name__ for k in range(graph.size())]
    assert stream.finish().control is None


def test_a_linearised_factor_of_another_solution_is_heard(stream):
    """As `condensed_factor` makes them; GTSAM cannot say how many rows such a factor has once it was text."""
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    known, values = odometry(shot, [0, 2, 4]), gtsam.Values()
    for i in (0, 2, 4):
        values.insert(X(i), metric(shot, 0).between(metric(shot, i)))
    linear = gtsam.NonlinearFactorGraph()
    for k in range(known.size()):
        linear.add(gtsam.LinearContainerFactor(known.at(k).linearize(values), values))
    stream.add_factors(linear, gtsam.Values())
    for image in shot.images[5:]:
        stream.push(image, keyframe=True)
    result = stream.finish()
    assert result.metric
    assert [r.name for r in result.control.residuals] == [f"LinearContainerFactor on x{i}, x{i + 2}" for i in (0, 2)]
    length = np.linalg.norm(result.camera_centers()[4] - result.camera_centers()[0])
    true = np.linalg.norm(metric(shot, 0).between(metric(shot, 4)).translation())
    assert length == pytest.approx(true, rel=0.02)


def test_fixes_in_another_world_are_told(stream):
    shot = rendered("truck")
    for image in shot.images[:5]:
        stream.push(image, keyframe=True)
    stream.trajectory()
    fixes = gtsam.NonlinearFactorGraph()
    for i in stream.keyframes:
        place = np.array([4000.0, 3000.0, 20.0]) + metric(shot, i).translation()
        fixes.add(gtsam.GPSFactor(X(i), place, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    stream.add_factors(fixes, gtsam.Values())
    notes = [stream.push(image, keyframe=True).note for image in shot.images[5:]]
    assert any("GPSFactor on x0 is off by " in note and "world of the first keyframe" in note for note in notes) or any(
        "are refused" in note for note in notes
    ), notes


def test_what_cannot_be_taken_is_said_at_once(stream):
    shot, nothing = rendered("truck"), gtsam.Values()
    with pytest.raises(InputError, match="there is no map yet"):
        stream.add_factors(odometry(shot, [0, 1]), nothing)
    for image in shot.images[:4]:
        stream.push(image, keyframe=True)
    with pytest.raises(InputError, match="unknown key x6: it is not a keyframe of the map"):
        stream.add_factors(odometry(shot, [3, 6]), nothing)
    custom = gtsam.NonlinearFactorGraph()
    custom.add(gtsam.CustomFactor(POSE_NOISE, [X(0)], lambda this, values, jacobians: np.zeros(6)))
    with pytest.raises(InputError, match="a Python callback"):
        stream.add_factors(custom, nothing)
    control = Control(distances=[KnownDistance(length=1.0, sigma=0.1, frames=(0, 5))])
    with Stream(shot.camera, control=control) as other, pytest.raises(InputError, match="a stream with control"):
        other.add_factors(odometry(shot, [0, 1]), nothing)


def test_factors_after_the_last_keyframe_are_heard_by_the_polish(stream):
    shot = rendered("truck")
    for image in shot.images:
        stream.push(image, keyframe=True)
    stream.trajectory()
    stream.add_factors(odometry(shot, list(stream.keyframes)), gtsam.Values())
    result = stream.finish()
    centers = result.camera_centers()
    true = metric(shot, 0).between(metric(shot, 7)).translation()
    assert np.linalg.norm(centers[-1] - centers[0]) == pytest.approx(np.linalg.norm(true), rel=3e-3)


@pytest.mark.parametrize("length", [None, 0.0])
def test_what_tells_no_length_leaves_the_unit_open(stream, length, tmp_path):
    """A rotation; a range of zero between cameras that move, to which no unit leads."""
    shot = rendered("truck")
    for image in shot.images:
        stream.push(image, keyframe=True)
    stream.trajectory()
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3] * 3 + [1e6] * 3))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.BetweenFactorPose3(X(1), X(4), metric(shot, 1).between(metric(shot, 4)), loose))
    if length is not None:
        graph.add(gtsam.RangeFactorPose3(X(0), X(4), length, gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)))
    stream.add_factors(graph, gtsam.Values())
    result = stream.finish()
    assert not result.metric
    assert result.control.scale_std == np.inf
    assert any(note.endswith("; they leave the unit of length open.") for note in result.notes)
    result.write(tmp_path / "out")
    assert not np.isfinite(read_result(tmp_path / "out").control.scale_std)


def test_lengths_of_which_none_agrees_leave_the_unit_open(stream):
    """Two ranges, one twice as long as the other: both are flagged, and what is between them is no metre."""
    shot = rendered("truck")
    for image in shot.images:
        stream.push(image, keyframe=True)
    stream.trajectory()
    length = float(np.linalg.norm(metric(shot, 0).between(metric(shot, 7)).translation()))
    graph, tight = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1] * 3 + [1e6] * 3))
    graph.add(gtsam.RangeFactorPose3(X(0), X(7), length, tight))
    graph.add(gtsam.RangeFactorPose3(X(0), X(7), 2.0 * length, tight))
    graph.add(gtsam.BetweenFactorPose3(X(1), X(4), metric(shot, 1).between(metric(shot, 4)), loose))
    stream.add_factors(graph, gtsam.Values())
    result = stream.finish()
    assert [r.contradicts for r in result.control.residuals] == [True, True, False]
    assert (result.metric, result.control.scale_std) == (False, np.inf)
    (note,) = (note for note in result.notes if note.startswith("Factors added: 1 items used"))
    assert note.endswith("; they leave the unit of length open.")
    assert any(note.startswith("2 factors contradict the images and the others: RangeFactor") for note in result.notes)


def affine_in_metres(shot: RenderedShot, k: int) -> tuple[float, float]:
    """Scale and shift of a simulated map, by the true depths."""
    predicted = 1.0 / (METRES * shot.depths[k].ravel())
    design = np.column_stack([predicted, np.ones_like(predicted)])
    scale, shift = np.linalg.lstsq(design, simulated_maps("truck")[k].ravel(), rcond=None)[0]
    return float(scale), float(shift)


def test_the_polish_hears_what_is_known_of_an_affine(stream):
    """The scale of one map in metres: the unit of the result follows it."""
    shot = rendered("truck")
    for image in shot.images:
        stream.push(image, keyframe=True)
    stream.trajectory()
    unit = stream._mapper.images[3].tracks.depth.unit  # what the graph has the values of this map in
    scale, shift = (value / unit for value in affine_in_metres(shot, 3))
    known = gtsam.Cal3_S2(scale / VIRTUAL_BASELINE, 1.0, 0.0, shift, 0.0)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorCal3_S2(A(3), known, native_affine_noise(0.02 * scale, 0.1)))
    stream.add_factors(graph, gtsam.Values())
    result = stream.finish()
    assert result.metric
    assert [r.name for r in result.control.residuals] == ["PriorFactorCal3_S2 on a3"]
    assert result.control.residuals[0].sigmas < 1.0
    assert result.frames[3].prior.scale == pytest.approx(unit * scale, rel=0.02)
    centers, true = result.camera_centers(), metric(shot, 0).between(metric(shot, 7)).translation()
    length = np.linalg.norm(centers[-1] - centers[0])
    assert length == pytest.approx(np.linalg.norm(true), rel=4 * result.control.scale_std)
    assert 0.008 < result.control.scale_std < 0.05


def test_variables_are_named_by_the_index_of_the_frame():
    shot = rendered("truck")
    indices = [100, 103, 101, 103, 200, 201, 202, 203]  # backwards, and one twice
    with Stream(shot.camera) as stream:
        for index, image in zip(indices, shot.images, strict=True):
            stream.push(Frame(index, image, f"{index:06d}", timestamp=index / 10), keyframe=True)
        stream.trajectory()
        keyframes, (_, values) = stream.keyframes, stream.graph()
    assert {*keyframes} <= {100, 103, 101, 104, 200, 201, 202, 203}
    assert keyframes[100] == 10.0
    assert {gtsam.symbolIndex(key) for key in list(values.keys()) if gtsam.symbolChr(key) == ord("x")} == {*keyframes}
