"""The benchmark of faults: what it injects, and that it would see what must not happen."""

import json

import numpy as np
import pycolmap
import pytest

from benchmarks.faults.__main__ import report
from benchmarks.faults.plan import Fault, FaultyPrior, KnownShot, Plan, PlannedFrame, disturbed, random_plan
from benchmarks.faults.run import Outcome
from benchmarks.faults.verdict import last_saved, wrong_updates
from benchmarks.live import sigmas
from factorsfm import Frame
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import synthetic_scene

FRAMES = 20


@pytest.fixture
def shots() -> list[KnownShot]:
    """Grey images whose value is the number of the frame; 100 more in the second shot."""
    scene = synthetic_scene("truck", FRAMES)
    truth = pose_arrays(scene.cam_from_world)
    depth = [np.ones((9, 16), np.float32)] * FRAMES
    return [
        KnownShot([np.full((18, 32, 3), first + k, np.uint8) for k in range(FRAMES)], depth, scene.camera, *truth)
        for first in (0, 100)
    ]


def planned(shots: list[KnownShot]) -> list[PlannedFrame]:
    return [PlannedFrame(image, (0, k)) for k, image in enumerate(shots[0].images)]


@pytest.mark.parametrize("fault", Fault)
@pytest.mark.parametrize("seed", range(5))
def test_what_is_injected_is_known(shots, fault, seed):
    before = planned(shots)
    found = disturbed(fault, before, shots, np.random.default_rng(seed))
    assert len(found) >= 10
    for frame in found:
        if frame.origin is not None and fault is not Fault.DAMAGED:
            shot, k = frame.origin
            assert frame.image[0, 0, 0] == 100 * shot + k
    unchanged = len(found) == FRAMES and all(a is b for a, b in zip(found, before, strict=True))
    assert unchanged == (fault is Fault.KILLED)
    prior = FaultyPrior(Plan([fault], shots, found))
    for k, frame in enumerate(found):
        if frame.depth_fault == "raise":
            with pytest.raises(RuntimeError):
                prior(Frame(k, frame.image, ""))
        else:
            assert np.isnan(prior(Frame(k, frame.image, "")).values).all() == (frame.depth_fault == "nan")


def test_plans_are_those_of_their_seed(monkeypatch, shots):
    monkeypatch.setattr("benchmarks.faults.plan._rendered_shot", lambda *_, **__: shots[0])
    for seed in range(10):
        one, other = random_plan(seed, None), random_plan(seed, None)
        assert one.faults == other.faults
        assert 1 <= len(set(one.faults)) == len(one.faults) <= 3
        assert (one.killed_at, one.kill_delay, one.is_film) == (other.killed_at, other.kill_delay, other.is_film)
        assert (one.killed_at is None) == (Fault.KILLED not in one.faults)
        for a, b in zip(one.frames, other.frames, strict=True):
            np.testing.assert_array_equal(a.image, b.image)


def test_errors_in_standard_deviations(shots):
    """Exact poses are 0 off, in any unit; a shift by 7 deviations is found at its frame."""
    shot = shots[0]
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(r), 3.0 * c).inverse()
        for r, c in zip(shot.rotations, shot.centers, strict=True)
    ]
    covariance = np.diag([1e-4] * 3 + [1e-6] * 3)
    covariances = [covariance] * FRAMES
    np.testing.assert_allclose(sigmas(poses, covariances, shot.rotations, shot.centers), 0.0, atol=1e-6)
    poses[5] = pycolmap.Rigid3d(poses[5].rotation, poses[5].translation + [0.0, 0.007, 0.0])
    off = sigmas(
        [*poses[:8], None, *poses[9:]], [*covariances[:9], None, *covariances[10:]], shot.rotations, shot.centers
    )
    assert off[5] == pytest.approx(7.0, rel=1e-9)
    assert np.isnan(off[8:10]).all()
    assert np.nanmax(np.delete(off, 5)) < 1e-9


def line(index: int, shot: KnownShot, k: int, shift: float = 0.0, number: int = 0, *, anew: bool = False) -> str:
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(shot.rotations[k]), shot.centers[k] + [0.0, shift, 0.0]).inverse()
    covariance = np.diag([1e-6] * 6).tolist()
    content = {"index": index, "shot": number, "pose": pose.matrix().tolist(), "covariance": covariance}
    return json.dumps({**content, "starts_anew": anew})


def test_wrong_poses_are_seen(shots, tmp_path):
    log, plan = tmp_path / "updates.jsonl", Plan([], shots, planned(shots))
    good = [line(k, shots[0], k) for k in range(FRAMES)]
    log.write_text("\n".join([*good, '{"saved": 12}', '{"index": 3, "sh']))
    assert wrong_updates(log, plan) == []
    assert last_saved(log) == 12
    log.write_text("\n".join([*good, line(7, shots[0], 7, 0.02)]))  # the newest update of a frame counts
    (fault,) = wrong_updates(log, plan)
    assert fault.startswith("frame 7 is off by 20.")
    plan.frames[4] = PlannedFrame(plan.frames[4].image, None)
    plan.frames[6] = PlannedFrame(shots[1].images[0], (1, 0))
    log.write_text("\n".join(good))
    assert wrong_updates(log, plan) == [f"frame {k} has a pose, but shows nothing of the shot" for k in (4, 6)]


def test_what_was_declared_void_is_not_wrong(shots, tmp_path):
    log, plan = tmp_path / "updates.jsonl", Plan([], shots, planned(shots))
    plan.frames[0] = PlannedFrame(plan.frames[0].image, None)
    for anew, wrong in ((2, []), (0, ["frame 0 has a pose, but shows nothing of the shot"])):
        log.write_text("\n".join(line(k, shots[0], k, anew=k == anew) for k in range(FRAMES)))
        assert wrong_updates(log, plan) == wrong


def test_every_kind_of_end_is_counted():
    outcomes = {
        0: Outcome(["black frames"], "40 of 40 frames"),
        1: Outcome(["black frames", Fault.KILLED], "", ["hangs: no end within 300 s"]),
        2: Outcome([Fault.KILLED], "0 of 9 frames registered, at least 2 needed"),
        3: Outcome([Fault.KILLED], "9 of 9 frames", ["frame 3 is off by 9.0 sigma"]),
        4: Outcome([Fault.KILLED], "", ["crashes with status -11: "]),
    }
    text = report(outcomes)
    assert "| black frames | 2 | 1 | 0 | 1 | 0 | 0 |" in text
    assert "| SIGKILL and resume | 4 | 1 | 1 | 1 | 1 | 1 |" in text
    assert "| all runs | 5 | 2 | 1 | 1 | 1 | 1 |" in text
    assert "- seed 3 (SIGKILL and resume): frame 3 is off by 9.0 sigma" in text
    assert "- seed 0" not in text
