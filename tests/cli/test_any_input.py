"""Whatever is given to the command line: one line on stderr, an exit status, and never a traceback."""

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorsfm.camera.files import camera_to_json, read_camera
from factorsfm.cli.main import main
from factorsfm.control.files import read_control
from factorsfm.result.reading import read_result
from factorsfm.support.errors import InputError
from tests.command_line import assert_error
from tests.export.test_export import build
from tests.export_problems import noise_images
from tests.rendered import quick_presets, rendered

LONG = "a" * 300
MANY_DIGITS = "9" * 5000


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: three images, their camera, and a result."""
    (tmp_path / "images").mkdir()
    for k, image in enumerate(rendered("dolly").images[:3]):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), image)
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(rendered("dolly").camera)))
    build().write(tmp_path / "result")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def status_of(*arguments: object) -> int:
    """Exit status of a command, whether the parser or the command ends it."""
    with suppress(SystemExit):
        return main([*map(str, arguments)])
    return 2  # of the parser


def reconstruct(source: object, *arguments: object) -> int:
    given = [
        "--camera",
        "camera.json",
        "--depth",
        "none",
        "--output",
        "out",
        *arguments,
    ]  # the last one of a kind counts
    return status_of("reconstruct", source, *given)


def png_of_a_size(width: int, height: int) -> bytes:
    """A file that claims to hold this many pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")


# --- names and paths ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["reconstruct", LONG, "--output", "out", "--depth", "none"],
        ["reconstruct", "images", "--output", LONG, "--depth", "none"],
        ["reconstruct", "images", "--output", "out", "--depth", LONG],
        ["reconstruct", "images", "--output", "out", "--depth", "none", "--camera", LONG],
        ["reconstruct", "images", "--output", "out", "--depth", "none", "--unordered", "--work", LONG],
        ["reconstruct", "images", "--output", "out", "--depth", "none", "--control", LONG],
        ["stream", LONG, "--output", "out", "--depth", "none"],
        ["stream", "images", "--output", "out", "--depth", "none", "--snapshot", LONG + "/x"],
        ["stream", "images", "--output", "out", "--depth", "none", "--resume", LONG],
        ["batch", LONG, "--output", "out"],
        ["extend", LONG, "images", "--output", "out"],
        ["export", LONG, "--format", "ply", "--output", "out"],
        ["export", "result", "--format", "ply", "--output", LONG],
        ["export", "result", "--format", "nuke", "--output", "out", "--footage", LONG],
        ["overlay", "result", "--output", LONG + ".mp4", "--source", "images"],
    ],
    ids=lambda arguments: " ".join(arguments).replace(LONG, "LONG"),
)
def test_a_name_that_no_system_takes(arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(*arguments) == 2
    assert_error(capsys.readouterr())
    assert not (folder / "out").exists()


def test_names_that_are_not_utf8(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reconstruct("\udcff") == 2
    assert_error(capsys.readouterr(), r"the argument '\udcff' is not UTF-8")
    shutil.copy(folder / "images" / "0.png", os.fsencode(folder / "images") + b"/\xff.png")
    for unordered in ([], ["--unordered"]):
        assert reconstruct("images", *unordered) == 2
        assert_error(capsys.readouterr(), r"the file name '\udcff.png' in images is not UTF-8; rename the file")
    assert not (folder / "out").exists()


def test_files_beside_the_images_may_have_any_name(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path(os.fsdecode(os.fsencode(folder / "images") + b"/\xff.txt")).touch()
    assert reconstruct("images", "--unordered") == 0
    assert r"Not images, and ignored: \udcff.txt." in read_result(folder / "out").notes
    capsys.readouterr()


def test_image_names_with_line_breaks(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(3):
        (folder / "images" / f"{k}.png").rename(folder / "images" / f"a\n{k}.png")
    assert reconstruct("images") == 0
    assert [frame.name for frame in read_result(folder / "out").frames] == [f"a\n{k}.png" for k in range(3)]
    capsys.readouterr()


def test_a_link_that_leads_nowhere_is_a_frame_that_cannot_be_read(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "images" / "3.png").symlink_to("nowhere.png")
    assert reconstruct("images") == 2
    assert_error(capsys.readouterr(), "image images/3.png cannot be read: No such file or directory")
    (folder / "images" / "3.png").unlink()
    (folder / "images" / "3.png").symlink_to("3.png")
    assert reconstruct("images") == 2
    assert_error(capsys.readouterr(), "image images/3.png cannot be read: Too many levels of symbolic links")
    assert not (folder / "out").exists()


def test_a_link_that_leads_nowhere_does_not_end_a_batch(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "films").mkdir()
    (folder / "films" / "gone.mp4").symlink_to("nowhere.mp4")
    assert status_of("batch", "films", "--output", "out", "--depth", "none", "--workers", "1") == 2
    assert_error(capsys.readouterr(), "gone.mp4 does not exist")


# --- images, ranges and sizes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(100_000, 100_000), (2**31 - 1, 1), (0, 0)])
def test_images_of_absurd_sizes(width: int, height: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "images" / "1.png").write_bytes(png_of_a_size(width, height))
    assert reconstruct("images") == 2
    assert_error(capsys.readouterr(), "1.png cannot be decoded")


@pytest.mark.parametrize(
    "text", ["", ":", "::", "1", "-1:5", "5:1", "0:0", "0:5:0", "1:2:3:4", f"0:{MANY_DIGITS}", "٣:٥", "0x1:5", "nan:"]
)
@pytest.mark.parametrize("command", ["reconstruct", "stream", "extend"])
def test_ranges_that_are_none(command: str, text: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = ["result", "images"] if command == "extend" else ["images", "--depth", "none"]
    assert status_of(command, *source, "--output", "out", "--frames", text) == 2
    assert_error(capsys.readouterr(), "range" if text != "-1:5" else "--frames")


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "result", "--format", "usd", "--output", "o.usda", "--first-frame", str(10**30)],
        ["export", "result", "--format", "usd", "--output", "o.usda", "--first-frame", str(2**31)],
        ["export", "result", "--format", "alembic", "--output", "out", "--fps", "1e-308"],
        ["export", "result", "--format", "blender", "--output", "out", "--sensor-width", "1e308"],
        ["export", "result", "--format", "colmap-binary", "--output", "out", "--scale", "1e308"],
        ["export", "result", "--format", "tum", "--output", "out", "--fps", "nan"],
        ["stream", f"camera:{MANY_DIGITS}", "--output", "out", "--depth", "none"],
        ["stream", "images", "--output", "out", "--depth", "none", "--raw", f"{MANY_DIGITS}x2:bgr24"],
        ["stream", "images", "--output", "out", "--snapshot", "s", "--snapshot-every", MANY_DIGITS],
        ["batch", "images", "--output", "out", "--workers", MANY_DIGITS],
        ["batch", "images", "--output", "out", "--workers", "²"],
    ],
    ids=lambda arguments: " ".join(arguments).replace(MANY_DIGITS, "MANY_DIGITS"),
)
def test_numbers_that_are_too_large(arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(*arguments) == 2
    assert_error(capsys.readouterr())
    assert {path.name for path in folder.iterdir()} == {"images", "camera.json", "result"}


# --- files of other kinds -----------------------------------------------------------------------------------------

JUNK = [b"", b"{", b"null", b"[" * 100_000, b"\xff\xfe", b'{"width": ' + MANY_DIGITS.encode() + b"}", bytes(5000)]


@pytest.mark.parametrize("content", JUNK, ids=range(len(JUNK)))
def test_files_that_hold_something_else(content: bytes, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "junk").write_bytes(content)
    (folder / "work").mkdir()
    (folder / "work" / "matches.db").write_bytes(content.ljust(5000, b"x"))
    (folder / "maps").mkdir()
    for k in range(3):
        (folder / "maps" / f"{k}.npy").write_bytes(content)
    (folder / "other").mkdir()
    (folder / "other" / "summary.json").write_bytes(content)
    for option in (
        ["--camera", "junk"],
        ["--control", "junk"],
        ["--depth", "junk"],
        ["--depth", "maps", "--depth-kind", "inverse"],
        ["--masks", "junk"],
        ["--objects", "junk"],
        ["--unordered", "--features", "junk"],
        ["--unordered", "--work", "junk"],
        ["--unordered", "--work", "work"],
        ["--output", "junk"],
        ["--output", "other"],
    ):
        assert reconstruct("images", *option) == 2, option
        assert_error(capsys.readouterr())
    for command in (
        ["reconstruct", "junk", "--output", "out", "--depth", "none"],
        ["stream", "junk", "--output", "out", "--depth", "none"],
        ["stream", "images", "--output", "out", "--depth", "none", "--resume", "junk"],
        ["batch", "junk", "--output", "out", "--depth", "none", "--workers", "1"],
        ["extend", "other", "images", "--output", "out"],
        ["export", "other", "--format", "ply", "--output", "out"],
        ["overlay", "other", "--output", "out.mp4"],
    ):
        assert status_of(*command) == 2, command
        assert_error(capsys.readouterr())
    assert not list(folder.glob("out*/*"))


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.just(10**400) | st.text(max_size=3),
    lambda parts: st.lists(parts, max_size=12) | st.dictionaries(st.sampled_from(["a", "frame", "pixels"]), parts),
    max_leaves=12,
)
CAMERA = {"width": 320, "height": 180, "fx": 300, "fy": 300, "cx": 159.5, "cy": 89.5}
MODELS = st.sampled_from(["PINHOLE", "OPENCV", "FULL_OPENCV", "FOV", "EQUIRECTANGULAR", "INVALID"])
POINT = {"name": "p", "pixels": {"a": [1, 2], "b": [3, 4]}, "position": [0, 0, 1], "sigma": 0.1}
CONTROL: dict[str, list[dict[str, Any]]] = {
    "poses": [{"frame": k, "position": [k, k * k, 0], "sigma": 0.1} for k in range(3)],
    "points": [{**POINT, "name": name} for name in "pqrs"],
    "distances": [{"length": 1, "sigma": 0.1, "frames": [0, 1]}, {"length": 1, "sigma": 0.1, "points": ["p", "q"]}],
    "heights": [{"frame": 0, "above": ["p", "q", "r"], "length": 1, "sigma": 0.1}],
}


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.dictionaries(st.sampled_from([*CAMERA, "model", "params"]), JSON | MODELS | st.lists(st.floats())))
def test_a_camera_file_with_anything_in_any_place(tmp_path: Path, changes: dict[str, Any]) -> None:
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | changes))
    assert_read_or_refused(read_camera, tmp_path / "camera.json")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_control_file_with_anything_in_any_place(tmp_path: Path, data: st.DataObject) -> None:
    content = json.loads(json.dumps(CONTROL))
    kind = data.draw(st.sampled_from([*CONTROL]))
    item = data.draw(st.sampled_from(content[kind]))
    item[data.draw(st.sampled_from([*item]))] = data.draw(JSON)
    (tmp_path / "control.json").write_text(json.dumps(content))
    assert_read_or_refused(read_control, tmp_path / "control.json")


def assert_read_or_refused(read: Callable[[Path], object], path: Path) -> None:
    with suppress(InputError):
        read(path)


@pytest.mark.parametrize(("position", "sigma"), [(1e308, 0.1), (-1e13, 0.1), (4.0, 1e-308), (4.0, 1e13)])
def test_control_whose_squares_would_overflow(
    folder: Path, capsys: pytest.CaptureFixture[str], position: float, sigma: float
) -> None:
    poses = [{"frame": k, "position": [k * position, k * k, 0], "sigma": sigma} for k in range(3)]
    (folder / "control.json").write_text(json.dumps({"poses": poses}))
    assert reconstruct("images", "--control", "control.json") == 2
    assert_error(capsys.readouterr(), "control file control.json: poses[")


def test_warnings_of_libraries_do_not_stand_beside_the_line_of_an_error(folder: Path) -> None:
    program = """
import sys, warnings
import factorsfm.api
from factorsfm.cli.main import main

def fail(*_, **__):
    warnings.warn("overflow")
    raise factorsfm.InputError("too large")

factorsfm.api.reconstruct = fail
sys.exit(main(["reconstruct", "images", "--output", "out"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "factorsfm: error: too large\n")


# --- the machine --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "words"), [(OSError(5, "Input/output error", "x.png"), "Input/output error: 'x.png'"),
                         (MemoryError(), "not enough memory")]
)  # fmt: skip
def test_what_the_machine_refuses_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("factorsfm.api.reconstruct", fail)
    assert reconstruct("images") == 2
    assert_error(capsys.readouterr(), words)


@pytest.mark.parametrize(
    ("arguments", "limit"),
    [
        (["reconstruct", "images", "--depth", "none", "--output", "out"], 3000),
        (["reconstruct", "images", "--depth", "none", "--output", "out", "--unordered"], 3000),
        (["export", "result", "--format", "alembic", "--output", "out"], 3000),
        (["export", "result", "--format", "undistorted", "--footage", "footage", "--output", "out"], 3000),
        (["overlay", "result", "--source", "footage", "--output", "out.avi"], 100_000),
    ],
    ids=["reconstruct", "set", "alembic", "undistorted", "overlay"],
)  # fmt: skip
def test_a_full_disk(folder: Path, arguments: list[str], limit: int) -> None:
    """Here no file can become larger than a limit, which programs see in the same way."""
    if "alembic" in arguments:
        pytest.importorskip("alembic3d")
    noise_images(folder / "footage", 21)
    before = {path.name for path in folder.iterdir()}
    done = subprocess.run(
        [sys.executable, "-m", "factorsfm", *arguments],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("factorsfm: error: ")
    assert done.stderr.count("\n") == 1
    assert {path.name for path in folder.iterdir()} == before
