"""An IMU beside a stream: metric scale, up, poses of frames that show nothing; and recordings that do not fit."""

import itertools
import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from factorsfm import (
    Control,
    Frame,
    FrameStatus,
    ImuNoise,
    ImuRecording,
    InputError,
    KnownDistance,
    Reconstruction,
    ReconstructionError,
    Stream,
    read_result,
    reconstruct,
)
from factorsfm.inertial.fit import ImuFit
from factorsfm.mapping.map_news import MapNews
from factorsfm.streaming import imu_source
from factorsfm.streaming.imu_result import _note
from factorsfm.streaming.imu_source import ImuSource
from factorsfm.support.rotations import exponential
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import handheld_path, simulate_imu
from factorsfm.synthetic.scene import room_camera
from factorsfm.synthetic.shot import render_views

SECONDS, FPS, OFFSET = 4.5, 24, 0.317
BLANK = range(60, 70)
DOWN = np.array([0.5, 9.7, 1.2]) / np.linalg.norm([0.5, 9.7, 1.2])
CAM_FROM_IMU = exponential(np.array([[0.3, -1.2, 0.7]]))[0]
PATH = handheld_path(SECONDS + 0.5, 1)
TIMES = 0.1 + np.arange(int(SECONDS * FPS)) / FPS
CAMERA = room_camera(320, 180)


@cache
def images():
    return list(render_views(PATH.poses(TIMES), 320, 180, 1))


def recording(path=PATH, seed=1):
    return simulate_imu(
        path, 200.0, gravity=9.81 * DOWN, gyroscope_bias=[0.01, -0.02, 0.015], accelerometer_bias=[0.1, -0.05, 0.15],
        cam_from_imu=CAM_FROM_IMU, time_offset=OFFSET, noise=ImuNoise(), seed=seed,
    )  # fmt: skip


def unknown(imu):
    return replace(imu, cam_from_imu=None, time_offset=None)


def frames(blank=range(0)):
    for k, image in enumerate(images()):
        yield Frame(k, np.full_like(image, 90) if k in blank else image, f"{k:06d}", timestamp=float(TIMES[k]))


@cache
def solved() -> tuple[Reconstruction, list[str]]:
    """With a recording whose clock and axes are unknown, and some blank frames; the result, and what was said live."""
    with Stream(CAMERA, imu=unknown(recording())) as stream:
        notes = [stream.push(frame).note for frame in frames(BLANK)]
        return stream.finish(), [note for note in notes if note]


def truth() -> tuple[np.ndarray, np.ndarray]:
    return pose_arrays(PATH.poses(TIMES))


def in_first_camera(centers, rotation):
    return (centers - centers[0]) @ rotation


@pytest.mark.slow
def test_lengths_are_metres():
    result, notes = solved()
    assert any(note.startswith("the factors added set the unit of length") for note in notes)
    rotations, centers = pose_arrays([frame.cam_from_world for frame in result.frames])
    true_rotations, true_centers = truth()
    found, true = in_first_camera(centers, rotations[0]), in_first_camera(true_centers, true_rotations[0])
    scale = np.sum(found * true) / np.sum(true**2)
    assert result.metric
    assert result.imu is not None
    assert 0.004 < result.imu.scale_std < 0.01
    assert abs(scale - 1.0) < 3 * result.imu.scale_std
    errors = np.linalg.norm(found - true, axis=1)
    assert np.median(errors) < 3e-3
    assert errors[list(BLANK)].max() < 0.02


@pytest.mark.slow
def test_up_clock_and_axes_are_found():
    result, _ = solved()
    fit = result.imu
    first = result.frames[0].cam_from_world.rotation.matrix().T  # world_from_cam
    up = first @ truth()[0][0].T @ -DOWN
    assert np.degrees(np.arccos(min(1.0, up @ fit.up))) < max(0.5, 3 * fit.up_std)
    assert 0.01 < fit.up_std < 0.5
    assert fit.time_offset == pytest.approx(OFFSET, abs=max(5e-4, 4 * fit.time_offset_std))
    turn = np.linalg.norm(fit.cam_from_imu @ CAM_FROM_IMU.T - np.eye(3)) / np.sqrt(2)
    assert np.degrees(turn) < max(0.2, 3 * fit.rotation_std)
    np.testing.assert_allclose(fit.gyroscope_bias @ CAM_FROM_IMU, [0.01, -0.02, 0.015], atol=2e-3)


@pytest.mark.slow
def test_frames_that_show_nothing_get_the_pose_of_the_imu(tmp_path):
    result, _ = solved()
    bridged = [frame for frame in result.frames if frame.status is FrameStatus.INERTIAL]
    assert [frame.index for frame in bridged] == list(BLANK)
    assert result.imu.frames == len(BLANK)
    rotations, _ = pose_arrays([frame.cam_from_world for frame in result.frames])
    true_rotations, _ = truth()
    for frame in bridged:
        off = (rotations[0].T @ rotations[frame.index]).T @ true_rotations[0].T @ true_rotations[frame.index]
        std = np.sqrt(np.linalg.eigvalsh(frame.covariance[:3, :3])[-1])
        assert np.arccos(min(1.0, (np.trace(off) - 1) / 2)) < max(4 * std, np.radians(0.1))
        assert np.degrees(std) < 0.5
        assert frame.message.startswith("pose of the IMU, rotation to ")
    assert any("The poses of 10 frames that show nothing are its own" in note for note in result.notes)
    result.write(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["imu"]["frames"] == 10
    back = read_result(tmp_path / "out")
    assert back.imu == result.imu
    assert sum(frame.registered for frame in back.frames) == len(TIMES)


@pytest.mark.slow
def test_a_recording_that_starts_late_and_a_snapshot(tmp_path):
    whole = recording()
    part = whole.time > 1.2
    imu = unknown(replace(
        whole, time=whole.time[part], gyroscope=whole.gyroscope[part], accelerometer=whole.accelerometer[part],
    ))  # fmt: skip
    with Stream(CAMERA, imu=imu) as stream:
        for frame in itertools.islice(frames(), 100):
            stream.push(frame)
        assert stream._imu.takes_part
        stream.save(tmp_path / "snapshot")
    with pytest.raises(InputError, match="the snapshot is of a stream with an IMU; its recording must be given, too"):
        Stream.load(tmp_path / "snapshot")
    with Stream.load(tmp_path / "snapshot", imu=imu) as stream:
        assert stream._imu.takes_part
        for frame in itertools.islice(frames(), 100, None):
            stream.push(frame)
        result = stream.finish()
    assert result.metric
    assert 0.004 < result.imu.scale_std < 0.012
    assert result.imu.time_offset == pytest.approx(OFFSET, abs=1e-3)
    centers = result.camera_centers()
    length, true = (np.linalg.norm(c[-1] - c[0]) for c in (centers, truth()[1]))
    assert length == pytest.approx(true, rel=3 * result.imu.scale_std)


@pytest.mark.parametrize(
    ("offset", "said"),
    [
        (0.317, "its clock is 317.0 ± 0.2 ms behind the video's"),
        (-1.7e9, "its clock is 1700000000.0000 ± 0.0002 s ahead of the video's"),
    ],
)
def test_clocks_are_told_in_a_fitting_unit(offset, said):
    fit = ImuFit(
        up=[0, -1, 0], up_std=0.1, scale_std=0.006, cam_from_imu=np.eye(3).tolist(), rotation_std=0.1,
        time_offset=offset, time_offset_std=2e-4, gyroscope_bias=[0, 0, 0], accelerometer_bias=[0, 0, 0], frames=0,
    )  # fmt: skip
    assert said in _note(fit)


@pytest.mark.slow
def test_with_an_unknown_lens_the_imu_joins_the_polish():
    """Lens, clock and axes unknown; lengths within 2 %."""
    true_rotations, true_centers = truth()
    with Stream(imu=unknown(recording())) as stream:
        for frame in frames():
            stream.push(frame)
        assert stream._imu.reason == "the lens is not known while frames arrive"
        result = stream.finish()
    assert result.metric
    rotations, centers = pose_arrays([frame.cam_from_world for frame in result.frames])
    found, true = in_first_camera(centers, rotations[0]), in_first_camera(true_centers, true_rotations[0])
    scale = np.sum(found * true) / np.sum(true**2)
    assert abs(scale - 1.0) < 0.02
    assert 0.004 < result.imu.scale_std < 0.02
    assert result.imu.time_offset == pytest.approx(OFFSET, abs=1e-3)
    up = rotations[0] @ true_rotations[0].T @ -DOWN
    assert np.degrees(np.arccos(min(1.0, up @ result.imu.up))) < 1.0


@pytest.mark.slow
def test_a_recording_of_something_else_is_refused_with_numbers():
    other = unknown(recording(handheld_path(SECONDS + 0.5, 78), 5))
    result = reconstruct(frames(), camera=CAMERA, depth=None, imu=other)
    assert (result.metric, result.imu) == (False, None)
    (note,) = (note for note in result.notes if note.startswith("IMU: "))
    assert note.startswith("IMU: it takes no part: ")
    assert sum(c.isdigit() for c in note) >= 4
    assert "correlation" in note


def test_frames_without_times_and_sets_are_refused():
    imu = recording()
    with Stream(CAMERA, imu=imu) as stream, pytest.raises(InputError, match="frame 0 has no time; an IMU needs those"):
        stream.push(images()[0])
    with Stream(CAMERA, imu=imu) as stream:
        stream.push(Frame(0, images()[0], "0", timestamp=0.0))
        for none in (None, float("nan")):
            with pytest.raises(InputError, match="frame 1 has no time"):
                stream.push(Frame(1, images()[1], "1", timestamp=none))
        stream.push(Frame(1, images()[1], "1", timestamp=1 / FPS))
        assert [image.tracks.frame for image in stream._mapper.images] == [0, 1]  # as if they had not come
    with pytest.raises(InputError, match="the IMU is of type str; the ImuRecording of open_imu is expected"):
        Stream(CAMERA, imu="imu.csv")
    with pytest.raises(InputError, match="an IMU goes with a video"):
        reconstruct(frames(), camera=CAMERA, depth=None, imu=imu, unordered=True)
    control = Control(distances=[KnownDistance(length=1.0, sigma=0.1, frames=(0, 5))])
    with pytest.raises(InputError, match="control and an IMU cannot both set the scale"):
        Stream(CAMERA, control=control, imu=imu)


def test_a_camera_that_does_not_accelerate_shows_no_scale():
    """At rest: the result is as without an IMU, and says why."""
    time = np.arange(0.0, 3.0, 0.005)
    still = ImuRecording(time, np.zeros((600, 3)), np.tile([0.0, -9.81, 0.0], (600, 1)), np.eye(3), time_offset=0.0)
    shot = [Frame(k, images()[0], f"{k:06d}", timestamp=k / FPS) for k in range(12)]
    result = reconstruct(shot, camera=CAMERA, depth=None, imu=still)
    assert not result.metric
    assert any(note.startswith("IMU: it takes no part: ") for note in result.notes)


def test_attempts_that_fail_become_rarer(monkeypatch):
    """Each takes all frames so far: every half second of ten minutes they would take longer than the video."""
    attempts = []

    def fails(recording, times, rotations):
        attempts.append(len(times))
        raise ReconstructionError("it does not fit")

    monkeypatch.setattr(imu_source, "fit_timing", fails)
    source = ImuSource(recording())
    mapper = SimpleNamespace(news=MapNews(), keyframes=[], images=[], refines_focal=False, started=True)
    for k in range(1200):
        mapper.keyframes.append(k)
        source.follow(mapper, k / 2)
    assert 40 < len(attempts) < 80
    assert max(np.diff(attempts)) < 120
    source.finish(mapper)
    assert attempts[-1] == 1200
    assert source.reason == "it does not fit"
