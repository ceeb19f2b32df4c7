"""Exit statuses, one-line errors and what each command hands on."""

import io
import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factorsfm.cli import demo
from factorsfm.cli.main import main
from factorsfm.evaluation.metrics import TrajectoryErrors
from factorsfm.result.summary import summary as summary_of
from factorsfm.support.errors import InputError, ReconstructionError
from tests.exact_result import build

CAMERA = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 319.5, "cy": 239.5}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replaces the reconstruction by a fixed result; records the arguments."""
    recorded: list[dict[str, Any]] = []

    def reconstruct(source: Any, **arguments: Any) -> Any:
        recorded.append({"source": source, **arguments})
        arguments["progress"]("tracking", 3, 6)
        return build()

    monkeypatch.setattr("factorsfm.api.reconstruct", reconstruct)
    return recorded


def fail_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def reconstruct(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("factorsfm.api.reconstruct", reconstruct)


def assert_one_error_line(captured: Any, *words: str) -> None:
    assert captured.out == ""
    assert captured.err.startswith("factorsfm: error: ")
    assert captured.err.count("\n") == 1
    assert captured.err.endswith("\n")
    for word in words:
        assert word in captured.err


def test_reconstruct_writes_the_result(
    tmp_path: Path, calls: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["reconstruct", "shot.mp4", "--output", str(out)]) == 0
    (call,) = calls
    del call["progress"]
    assert call == {
        "source": "shot.mp4",
        "camera": None,
        "depth": "tcmonodepth",
        "depth_kind": None,
        "masks": None,
        "objects": None,
        "frames": None,
        "fields": "auto",
        "pixel_aspect": None,
        "lens": "auto",
        "shutter": "auto",
        "control": None,
        "tracks": None,
        "imu": None,
        "preset": "default",
        "unordered": None,
        "features": "sift",
        "work": None,
    }
    captured = capsys.readouterr()
    assert captured.err == ""  # no progress where stderr is no terminal
    assert "5 of 6 frames registered, 40 points" in captured.out
    assert "The focal length was guessed." in captured.out
    assert json.loads((out / "summary.json").read_text())["registered"] == 5


def test_options_are_handed_on(tmp_path: Path, calls: list[dict[str, Any]]) -> None:
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    arguments = ["--camera", str(tmp_path / "camera.json"), "--depth", "none", "--depth-kind", "metric"]
    arguments += ["--masks", "m", "--objects", "o", "--frames", "5:50:3", "--preset", "paper"]
    arguments += ["--fields", "blend", "--pixel-aspect", "2"]
    assert main(["reconstruct", "images", "--output", str(tmp_path / "out"), *arguments]) == 0
    (call,) = calls
    assert call["camera"].params.tolist() == [500, 500, 320, 240]
    assert (call["depth"], call["depth_kind"], call["masks"], call["objects"]) == (None, "metric", "m", "o")
    assert (call["frames"], call["preset"]) == (slice(5, 50, 3), "paper")
    assert (call["fields"], call["pixel_aspect"]) == ("blend", 2.0)


def test_progress_is_one_line_on_a_terminal(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]) == 0
    error = capsys.readouterr().err
    assert "\r\x1b[Ktracking 3/6" in error
    assert error.endswith("\r\x1b[K")
    assert "\n" not in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["COMMAND", "--help"]),
        (["reconstruct", "shot.mp4"], ["--output"]),
        (["reconstruct", "shot.mp4", "--output", "OUT", "--preset", "best"], ["--preset", "best", "paper"]),
        (["reconstruct", "shot.mp4", "--output", "OUT", "--depth-kind", "far"], ["--depth-kind", "metric"]),
        (["reconstruct", "shot.mp4", "--output", "OUT", "--colour"], ["--colour"]),
    ],
)
def test_bad_arguments(arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert_one_error_line(capsys.readouterr(), *words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--frames", "9:3"], ["9:3"]),
        (["--frames", "many"], ["many"]),
        (["--camera", "missing.json"], ["missing.json"]),
    ],
)
def test_bad_input_is_found_before_the_work(
    tmp_path: Path,
    calls: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: list[str],
) -> None:
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out"), *arguments]) == 2
    assert_one_error_line(capsys.readouterr(), *words)
    assert calls == []
    assert list(tmp_path.iterdir()) == []


def test_output_is_checked_before_the_work(
    tmp_path: Path, calls: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "precious.txt").write_text("x")
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path)]) == 2
    assert_one_error_line(capsys.readouterr(), str(tmp_path), "not empty")
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "precious.txt" / "out")]) == 2
    assert_one_error_line(capsys.readouterr(), "precious.txt")
    assert calls == []
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_input_error_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_with(monkeypatch, InputError("shot.mp4 does not exist,\nreally"))
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]) == 2
    assert_one_error_line(capsys.readouterr(), "shot.mp4 does not exist, really")
    assert list(tmp_path.iterdir()) == []


def test_a_shot_that_cannot_be_reconstructed_leaves_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_with(monkeypatch, ReconstructionError("12 tracks found, 30 needed"))
    out = tmp_path / "out"
    assert main(["reconstruct", "shot.mp4", "--output", str(out), "--preset", "geometry"]) == 3
    assert_one_error_line(capsys.readouterr(), "12 tracks found, 30 needed")
    assert {p.name for p in out.iterdir()} == {"summary.json", "report.html"}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["reason"] == summary["verdict"] == "12 tracks found, 30 needed"
    assert summary.keys() >= summary_of(build()).keys()  # who reads one reads the other
    assert (summary["source"], summary["options"]["preset"]) == ("shot.mp4", "geometry")


def test_a_black_shot_leaves_the_status_of_every_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The reason is the footage, not the folder of depth maps that nothing asked."""
    for folder in ("images", "depth"):
        (tmp_path / folder).mkdir()
    for k in range(4):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), np.zeros((90, 160, 3), np.uint8))
        np.save(tmp_path / "depth" / f"{k}.npy", np.ones((90, 160), np.float32))
    arguments = ["--depth", str(tmp_path / "depth"), "--depth-kind", "inverse", "--output", str(tmp_path / "out")]
    assert main(["reconstruct", str(tmp_path / "images"), *arguments]) == 3
    assert_one_error_line(capsys.readouterr(), "0 of 4 frames registered", "contrast")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"], summary["registered"]) == (4, 0)
    assert [status["name"] for status in summary["statuses"]] == ["0.png", "1.png", "2.png", "3.png"]
    assert {status["status"] for status in summary["statuses"]} == {"blank"}


@pytest.mark.parametrize(
    ("arguments", "level"),
    [([], logging.WARNING), (["-v"], logging.INFO), (["-vv"], logging.DEBUG)],
)
@pytest.mark.parametrize("before", [True, False])
def test_verbose_stands_before_or_after_the_command(
    tmp_path: Path, calls: list[dict[str, Any]], arguments: list[str], level: int, before: bool
) -> None:
    logging.getLogger().handlers.clear()  # else logging is taken as configured
    command = ["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]
    assert main([*arguments, *command] if before else [*command, *arguments]) == 0
    assert logging.getLogger().level == level


@pytest.mark.parametrize("raised", [InputError("no"), ReconstructionError("no"), None])
def test_warnings_of_bad_input_do_not_stand_beside_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], raised: Exception | None
) -> None:
    def reconstruct(*_: Any, **__: Any) -> Any:
        logging.getLogger("factorsfm").warning("a guess")
        if raised is not None:
            raise raised
        return build()

    monkeypatch.setattr("factorsfm.api.reconstruct", reconstruct)
    logging.getLogger().handlers.clear()  # else logging is taken as configured
    main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert said.startswith("factorsfm: error: no") or "WARNING factorsfm: a guess\n" in said
    assert ("a guess" in said) != isinstance(raised, InputError)


@pytest.mark.parametrize(("flags", "lines"), [([], 6), (["-v"], 20)])
def test_warnings_that_say_the_same_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flags: list[str], lines: int
) -> None:
    """One text, and one sentence on ten files: the first three of a sort are shown, the last one with the rest."""

    def reconstruct(*_: Any, **__: Any) -> Any:
        for k in range(10):
            logging.getLogger("factorsfm").warning("image %d.jpg is left out", k)
            logging.getLogger("factorsfm.lens").warning("a guess")
        return build()

    monkeypatch.setattr("factorsfm.api.reconstruct", reconstruct)
    logging.getLogger().handlers.clear()  # else logging is taken as configured
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out"), *flags]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("WARNING")]
    assert len(said) == lines
    assert said[0] == "WARNING factorsfm: image 0.jpg is left out"
    if not flags:
        assert set(said[-2:]) == {
            "WARNING factorsfm: 7 more like this: image 9.jpg is left out",
            "WARNING factorsfm.lens: 9 more like this: a guess",
        }


@pytest.mark.parametrize("name", ["é ö", "plain"])
def test_an_output_that_is_not_utf8_gets_escapes(
    tmp_path: Path, calls: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("factorsfm.cli.command.conclusion", lambda *_: f"{name}: 1 ± 2")
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, "ascii"))
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / name)]) == 0
    assert written.getvalue().decode() == f"{name}: 1 ± 2\n".encode("ascii", "backslashreplace").decode()


class Full(io.StringIO):
    """A full disk."""

    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


def test_a_full_output_is_no_failure_of_the_work(
    tmp_path: Path, calls: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]
    monkeypatch.setattr("sys.stdout", Full())
    assert main(command) == 0
    assert (
        capsys.readouterr().err == "factorsfm: done, but standard output cannot be written: No space left on device\n"
    )
    monkeypatch.setattr("sys.stderr", Full())
    assert main(command) == 0
    assert main(["export", str(tmp_path), "--format", "ply", "--output", str(tmp_path / "a.ply")]) == 2


def test_closed_outputs(tmp_path: Path, calls: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("sys.stderr", None)
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]) == 0


def test_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fail_with(monkeypatch, KeyboardInterrupt())
    assert main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "factorsfm: interrupted\n"
    assert list(tmp_path.iterdir()) == []


def test_bugs_are_not_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_with(monkeypatch, ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        main(["reconstruct", "shot.mp4", "--output", str(tmp_path / "out")])


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    for argument in ("--version", "--help"):
        with pytest.raises(SystemExit) as exit_:
            main([argument])
        assert exit_.value.code == 0
        assert "factorsfm" in capsys.readouterr().out


def test_demo_reconstructs_the_rendered_file_and_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = demo.render_shot(frames=6, width=96, height=64)

    def reconstruct(source: Path, **arguments: Any) -> Any:
        assert source.is_file()
        assert len(list(Path(arguments["depth"]).iterdir())) == 6
        np.testing.assert_allclose(arguments["camera"].params, shot.camera.params)
        result = build(unregistered=())
        for frame, pose in zip(result.frames, shot.cam_from_world, strict=True):
            frame.cam_from_world = pose
        return result

    monkeypatch.setattr("factorsfm.cli.demo.render_shot", lambda: shot)
    monkeypatch.setattr("factorsfm.api.reconstruct", reconstruct)
    assert main(["demo", "--output", str(tmp_path / "demo")]) == 0
    output = capsys.readouterr().out
    assert "camera position 0.00 % of the path's length" in output
    assert "0.0000 degrees" in output
    assert {p.name for p in (tmp_path / "demo").iterdir()} >= {"picture.png", "report.html", "summary.json"}


def test_comparison_is_a_share_of_the_path() -> None:
    errors = TrajectoryErrors(np.full(3, 0.02), np.full(2, 0.01), np.full(2, 0.25), None)
    text = demo.DemoResult(build(), errors, path_length=2.0).comparison()
    assert "camera position 1.00 %" in text
    assert "from frame to frame 0.50 % and 0.2500 degrees" in text


@pytest.fixture(autouse=True)
def _restore_logging() -> Any:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = before
