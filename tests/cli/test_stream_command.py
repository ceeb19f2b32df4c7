"""``factorsfm stream``: what it writes, how it ends, and how it goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import factorsfm
from factorsfm.camera.files import camera_to_json
from factorsfm.cli.main import main
from tests.command_line import assert_error, trajectory
from tests.instruments import CHECKS, write_walk
from tests.rendered import FRAMES, quick_presets, rendered, simulated_maps

Run = Callable[..., int]
TIMEOUT = 120.0


def write_images(folder: Path, images: list[np.ndarray], first: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    for k, image in enumerate(images, first):
        cv2.imwrite(str(folder / f".{k:06d}.png"), image)
        (folder / f".{k:06d}.png").rename(folder / f"{k:06d}.png")
    return folder


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    """Camera and depth of the rendered dolly."""
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(rendered("dolly").camera)))
    (tmp_path / "depth").mkdir()
    for k, values in enumerate(simulated_maps("dolly")):
        np.save(tmp_path / "depth" / f"{k:06d}.npy", values)
    depth = ["--depth", str(tmp_path / "depth"), "--depth-kind", "inverse"]
    return ["--camera", str(tmp_path / "camera.json"), *depth]


@pytest.fixture
def stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: list[str]) -> Run:
    """Runs the command in this process, with fewer tracks, on the images of the dolly unless told otherwise."""
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())

    def run(*arguments: object, source: object = None, output: str = "out") -> int:
        source = write_images(tmp_path / "images", rendered("dolly").images) if source is None else source
        return main(["stream", str(source), "--output", str(tmp_path / output), *given, *map(str, arguments)])

    return run


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_a_stream_gives_the_result_of_the_one_call(
    tmp_path: Path, stream: Run, given: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert stream() == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert f"all {FRAMES} frames registered" in captured.out
    assert f"Result in {tmp_path / 'out'}" in captured.out
    assert main(["reconstruct", str(tmp_path / "images"), "--output", str(tmp_path / "once"), *given]) == 0
    np.testing.assert_array_equal(trajectory(tmp_path / "out"), trajectory(tmp_path / "once"))
    streamed, once = summary(tmp_path / "out"), summary(tmp_path / "once")
    assert streamed["source"] == once["source"] == str(tmp_path / "images")
    known = {"depth": "depth", "depth_kind": "inverse", "masks": None, "frames": None}
    assert known.items() <= streamed["options"].items()
    assert known.items() <= once["options"].items()
    assert (streamed["points"], streamed["notes"]) == (once["points"], once["notes"])
    assert 0.0 < streamed["seconds"]["total"] < TIMEOUT


def test_the_line_of_progress(stream: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((200, 24)))
    monkeypatch.setattr("factorsfm.cli.progress_line.ProgressLine._SECONDS_BETWEEN", 0.0)
    monkeypatch.setattr("sys.stdout", sys.stderr)  # as on a terminal
    assert stream("--frames", "2:6") == 0
    lines = capsys.readouterr().err.split("\r\x1b[K")
    frames = [line for line in lines if line.startswith("frame ")]
    assert [line.split(",")[0] for line in frames] == [f"frame {k}" for k in range(2, 6)]
    for line in frames:
        assert " frames/s, latency " in line
        assert "; registered: " in line
    assert "the start of a map" in frames[0]
    assert all("inliers within" in line for line in frames[1:])
    assert "writing" in lines
    assert lines[-1].startswith("all 4 frames registered")


def test_raw_frames_and_their_end_in_the_middle_of_one(
    tmp_path: Path,
    stream: Run,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = b"".join(image.tobytes() for image in rendered("dolly").images)
    (tmp_path / "raw").write_bytes(data[:-1000])
    with (tmp_path / "raw").open() as file:
        monkeypatch.setattr("sys.stdin", file)
        assert stream("--raw", "320x180:bgr24", source="-") == 0
    assert f"broken off after {FRAMES - 1} frames: standard input ended inside frame {FRAMES - 1}" in caplog.text
    assert f"Note: Broken off after {FRAMES - 1} frames" in capsys.readouterr().out
    assert summary(tmp_path / "out")["registered"] == FRAMES - 1


def test_a_watched_folder_and_its_end_file(tmp_path: Path, stream: Run) -> None:
    folder = write_images(tmp_path / "images", rendered("dolly").images)
    (folder / "complete").touch()
    assert stream("--watch", "--end-file", "complete", "--stall-seconds", "none") == 0
    assert summary(tmp_path / "out")["registered"] == FRAMES


def test_every_shot_its_own_result(tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str]) -> None:
    black = [np.zeros((180, 320, 3), np.uint8)]
    film = [*rendered("dolly").images, *(image[::-1, ::-1] for image in rendered("truck").images)]
    write_images(tmp_path / "images", film)
    assert stream("--cuts", "--depth", "none", source=tmp_path / "images") == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["shot-001", "shot-002"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"shot-001, frames 0 to {FRAMES - 1}: all {FRAMES} frames registered")
    assert lines[1].startswith(f"shot-002, frames {FRAMES} to {2 * FRAMES - 1}: all {FRAMES} frames registered")
    assert trajectory(tmp_path / "out" / "shot-002")[:, 0].tolist() == list(range(FRAMES, 2 * FRAMES))
    assert stream("--cuts", source=tmp_path / "images") == 2
    assert_error(capsys.readouterr(), "not empty")
    (tmp_path / "none" / ".factorsfm-ab12").mkdir(parents=True)  # of a program that was killed
    assert stream("--cuts", source=write_images(tmp_path / "black", 3 * black), output="none") == 3
    assert_error(capsys.readouterr(), "none of 1 shots", "contrast")
    assert summary(tmp_path / "none" / "shot-001")["reconstructed"] is False


def test_going_on_from_a_snapshot(tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str]) -> None:
    snapshot = tmp_path / "state"
    assert stream("--frames", ":5", "--snapshot", snapshot, "--snapshot-every", 2) == 0
    assert len(factorsfm.Stream.load(snapshot).frames) == 5
    assert stream("--resume", snapshot, output="resumed") == 0
    assert stream(output="whole") == 0
    whole, resumed = trajectory(tmp_path / "whole"), trajectory(tmp_path / "resumed")
    np.testing.assert_allclose(resumed, whole, rtol=0.0, atol=1e-9)
    assert stream("--frames", ":5", "--resume", snapshot, output="nothing_new") == 0
    np.testing.assert_allclose(trajectory(tmp_path / "nothing_new"), trajectory(tmp_path / "out"), rtol=0.0, atol=1e-9)
    capsys.readouterr()
    assert stream("--resume", snapshot, "--preset", "paper", output="other") == 2
    assert_error(capsys.readouterr(), "--preset default, not paper")
    (tmp_path / "torn").write_bytes(snapshot.read_bytes()[:-1])
    assert stream("--resume", tmp_path / "torn", output="other") == 2
    assert_error(capsys.readouterr(), "torn", "checksum")
    other = camera_to_json(factorsfm.guess_camera(320, 180))
    (tmp_path / "camera.json").write_text(json.dumps(other))
    assert stream("--resume", snapshot, output="other") == 2
    assert_error(capsys.readouterr(), "another camera")
    assert not (tmp_path / "other").exists()


def test_a_live_source_goes_on(tmp_path: Path, stream: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, part in (("first", slice(0, 5)), ("second", slice(5, None))):
        (tmp_path / name).write_bytes(b"".join(image.tobytes() for image in rendered("dolly").images[part]))
    assert stream(output="whole") == 0
    assert stream("--cuts", output="whole") == 2  # shots would stand beside a result of the whole
    for name, more in (("first", ["--snapshot"]), ("second", ["--resume"])):
        with (tmp_path / name).open() as file:
            monkeypatch.setattr("sys.stdin", file)
            assert stream("--raw", "320x180:bgr24", *more, tmp_path / "state", source="-", output=f"out {name}") == 0
    assert trajectory(tmp_path / "out second")[:, 0].tolist() == list(range(FRAMES))
    np.testing.assert_allclose(trajectory(tmp_path / "out second"), trajectory(tmp_path / "whole"), rtol=0.0, atol=1e-9)


def test_a_snapshot_that_cannot_be_written_does_not_end_the_stream(
    tmp_path: Path, stream: Run, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "folder").mkdir()
    assert stream("--snapshot", tmp_path / "folder", "--snapshot-every", 4) == 0
    assert caplog.text.count("cannot be written") == 3  # every four frames, and at the end
    assert summary(tmp_path / "out")["registered"] == FRAMES


@pytest.mark.parametrize("option", ["--snapshot", "--record"])
def test_neither_snapshot_nor_recording_replaces_the_source(
    tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    source = write_images(tmp_path / "images", rendered("dolly").images[:2])
    before = (source / "000001.png").read_bytes()
    (tmp_path / "link").symlink_to(source)
    assert stream(option, tmp_path / "link" / "000001.png", source=source) == 2
    assert_error(capsys.readouterr(), "000001.png would overwrite the footage")
    assert (source / "000001.png").read_bytes() == before


def test_record(tmp_path: Path, stream: Run) -> None:
    pytest.importorskip("rerun")
    assert stream("--record", tmp_path / "shot.rrd") == 0
    assert (tmp_path / "shot.rrd").read_bytes()[:3] == b"RRF"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--snapshot-every", "5"], ["--snapshot FILE"]),
        (["--cuts", "--resume", "x"], ["--cuts", "--resume"]),
        (["--snapshot", "absent/state"], ["absent/state", "folder"]),
        (["--resume", "absent"], ["absent", "cannot be read"]),
        (["--raw", "320x180"], ["320x180", "WIDTHxHEIGHT:PIXELS"]),
        (["--raw", "320x180:bgr24"], ["raw format"]),
        (["--end-file", "complete"], ["complete", "watched"]),
        (["--record", "absent/x.rrd"], ["absent/x.rrd"]),
        (["--frames", "99:"], ["no frames from number 99"]),
        (["--masks", "absent"], ["absent"]),
    ],
)
def test_bad_input(
    tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
) -> None:
    if "--record" in arguments:
        pytest.importorskip("rerun")
    assert stream(*arguments) == 2
    assert_error(capsys.readouterr(), *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", [["--stall-seconds", "-1"], ["--stall-seconds", "x"], ["--snapshot-every", "0"]])
def test_bad_arguments(stream: Run, option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        stream(*option)
    assert exit_.value.code == 2
    assert_error(capsys.readouterr(), *option)


def test_a_black_source(tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_images(tmp_path / "black", [np.zeros((180, 320, 3), np.uint8)] * 3)
    assert stream(source=source) == 3
    assert_error(capsys.readouterr(), "0 of 3 frames registered", "contrast")
    assert summary(tmp_path / "out")["reason"].startswith("0 of 3 frames")


def test_the_password_of_a_url_is_not_written(
    tmp_path: Path, stream: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = factorsfm.open_source

    def opened(source: str, **arguments: object) -> factorsfm.Source:
        found = real(rendered("dolly").images, **arguments)
        found.name = "rtsp://host/stream"
        return found

    monkeypatch.setattr("factorsfm.cli.stream.open_source", opened)
    assert stream(source="rtsp://me:secret@host/stream?token=secret") == 0
    assert summary(tmp_path / "out")["source"] == "rtsp://host/stream"
    assert "secret" not in "".join(path.read_text() for path in (tmp_path / "out").glob("*.[jh]*"))


class Process:
    """The command in a process of its own, on a folder that never ends."""

    def __init__(self, folder: Path, output: Path, *arguments: str) -> None:
        command = [sys.executable, "-m", "factorsfm", "stream", str(folder), "--watch", "--stall-seconds", "none"]
        self.process = subprocess.Popen(
            [*command, "--output", str(output), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(Path(factorsfm.__file__).parents[1])},
        )

    def wait_for(self, happened: Callable[[], bool]) -> None:
        end = time.monotonic() + TIMEOUT
        while not happened():
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < end, "nothing happened"
            time.sleep(0.02)

    def end_by(self, number: int) -> tuple[int, str, str]:
        self.process.send_signal(number)
        output, error = self.process.communicate(timeout=TIMEOUT)
        return self.process.returncode, output, error


def seen(snapshot: Path) -> int:
    return len(factorsfm.Stream.load(snapshot).frames) if snapshot.exists() else 0


def test_interrupted_it_writes_what_there_is(tmp_path: Path, given: list[str]) -> None:
    folder = write_images(tmp_path / "images", rendered("dolly").images)
    snapshot = tmp_path / "state"
    process = Process(folder, tmp_path / "out", *given, "--snapshot", str(snapshot), "--snapshot-every", "1", "--watch")
    process.wait_for(lambda: seen(snapshot) == FRAMES)
    status, output, error = process.end_by(signal.SIGINT)
    assert (status, error) == (0, "")
    assert f"all {FRAMES} frames registered" in output
    assert summary(tmp_path / "out")["registered"] == FRAMES


def test_killed_it_goes_on_from_the_last_snapshot(tmp_path: Path, given: list[str]) -> None:
    images = rendered("dolly").images
    folder = write_images(tmp_path / "images", images[:5])
    snapshot = tmp_path / "state"
    process = Process(folder, tmp_path / "out", *given, "--snapshot", str(snapshot), "--snapshot-every", "1")
    process.wait_for(lambda: seen(snapshot) == 5)
    assert process.end_by(signal.SIGKILL)[0] == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    assert seen(snapshot) == 5
    write_images(folder, images[5:], 5)
    (folder / "complete").touch()
    again = [*given, "--watch", "--end-file", "complete", "--stall-seconds", "none"]
    command = ["stream", str(folder), "--output", str(tmp_path / "out"), *again]
    assert main([*command, "--resume", str(snapshot)]) == 0
    assert main(["reconstruct", str(folder), "--output", str(tmp_path / "once"), *given]) == 0
    np.testing.assert_allclose(trajectory(tmp_path / "out"), trajectory(tmp_path / "once"), rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_an_imu_beside_a_stream_and_a_snapshot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(tmp_path)
    given = ["--camera", tmp_path / "walk.json", "--depth", "none", "--imu", tmp_path / "imu.csv"]

    def run(output: str, *more: object) -> int:
        return main([*map(str, ["stream", tmp_path / "walk.mp4", "--output", tmp_path / output, *given, *more])])

    imu = factorsfm.open_imu(tmp_path / "imu.csv")
    with factorsfm.Stream(factorsfm.read_camera(tmp_path / "walk.json"), imu=imu) as stream:
        for frame in factorsfm.read_frames(tmp_path / "walk.mp4", slice(0, 90)):
            stream.push(frame)
        stream.save(tmp_path / "state")
    assert run("out", "--resume", tmp_path / "state") == 0
    assert 0.004 < summary(tmp_path / "out")["imu"]["scale_std"] < 0.012
    CHECKS["walk.mp4"]({"reconstruction": factorsfm.read_result(tmp_path / "out")}, rendered("dolly"))
    capsys.readouterr()
    given = given[:-2]
    assert run("none", "--resume", tmp_path / "state") == 2
    assert_error(capsys.readouterr(), "the snapshot is of a stream with an IMU; its recording must be given, too")


def test_what_an_imu_needs_of_a_stream(tmp_path: Path, stream: Run, capsys: pytest.CaptureFixture[str]) -> None:
    samples = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.81, 0.0], (200, 1))
    samples[:, 0] = np.arange(200) / 200
    names = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    np.savetxt(tmp_path / "imu.csv", samples, delimiter=",", header=names, comments="")
    imu = ["--imu", tmp_path / "imu.csv"]
    assert stream("--imu", tmp_path / "other.csv") == 2
    assert_error(capsys.readouterr(), "other.csv")
    assert stream(*imu) == 2
    assert_error(capsys.readouterr(), "frame 0 has no time; an IMU needs those of all frames")
    assert stream(*imu, "--cuts") == 2
    assert_error(capsys.readouterr(), "--cuts cannot be combined with --imu")
    assert stream("--snapshot", tmp_path / "state", "--frames", "0:3") == 0
    capsys.readouterr()
    assert stream(*imu, "--resume", tmp_path / "state") == 2
    assert_error(capsys.readouterr(), "the snapshot is of a stream without an IMU; a recording cannot join it")
