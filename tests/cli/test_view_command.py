"""``factorsfm view``: the report in the browser, or where it is."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm.cli.main import main
from factorsfm.report.document import data_of
from factorsfm.report.result_folder import write_failure, write_folder
from tests.alignment.test_align import room
from tests.command_line import assert_error
from tests.exact_result import build
from tests.report.test_overlay import write_footage


@pytest.mark.parametrize(
    ("options", "works", "said"), [([], True, "Opened"), ([], False, "Open"), (["--no-browser"], True, "Open")]
)
def test_the_report_is_opened_or_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    works: bool,
    said: str,
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or works)
    write_folder(build(), tmp_path / "a result")
    monkeypatch.chdir(tmp_path)
    assert main(["view", "a result", *options]) == 0
    page = tmp_path / "a result" / "report.html"
    assert capsys.readouterr().out.startswith(f"{said} {page}")
    assert opened == ([] if options else [page.as_uri()])


def test_a_shot_that_failed_has_a_report_and_another_folder_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_failure(tmp_path / "failed", "all frames are black")
    assert main(["view", str(tmp_path / "failed"), "--no-browser"]) == 0
    capsys.readouterr()
    for folder in (tmp_path, tmp_path / "nothing"):
        assert main(["view", str(folder)]) == 2
        assert_error(capsys.readouterr(), f"{folder} holds no report of factorsfm")


def seen_in(page: Path) -> list[tuple[int, int]]:
    """Width and height of the pictures of a page."""
    pictures = [base64.b64decode(text) for text in data_of(page.read_text())["thumbnail"] if text]
    return [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape[1::-1] for jpeg in pictures]


def test_the_pictures_are_large_where_the_footage_is_at_hand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result, folder, moved = room(), tmp_path / "result", tmp_path / "moved.avi"
    result.options = {"source": str(write_footage(tmp_path / "shot.avi"))}
    write_folder(result, folder)
    view = ["view", str(folder), "--no-browser"]
    assert main(view) == 0
    assert str(folder / "view.html") in capsys.readouterr().out
    assert seen_in(folder / "view.html") == [(480, 270)] * len(result.frames)
    report, page = (data_of((folder / name).read_text()) for name in ("report.html", "view.html"))
    assert {key for key in page if page[key] != report.get(key)} == {"thumbnail"}
    (tmp_path / "shot.avi").rename(moved)
    assert main(view) == 0
    assert str(folder / "report.html") in capsys.readouterr().out
    assert main([*view, "--footage", str(moved)]) == 0
    assert data_of((folder / "view.html").read_text())["footage"] == str(moved)
    write_folder(result, folder)
    assert not (folder / "view.html").exists()


def test_a_folder_that_cannot_be_written_is_looked_at_with_small_pictures(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    result, folder = room(), tmp_path / "result"
    result.options = {"source": str(write_footage(tmp_path / "shot.avi"))}
    write_folder(result, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def read_only(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    with monkeypatch.context() as patch:  # permissions do not hold root back
        patch.setattr("tempfile.TemporaryDirectory", read_only)
        assert main(["view", str(folder), "--no-browser"]) == 0
    assert capsys.readouterr().out.startswith(f"Open {folder / 'report.html'} in a browser")
    reason = f"cannot write the output {folder / 'view.html'}: Read-only file system"
    assert caplog.messages == [f"{reason}; the pictures are the small ones of report.html"]
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_other_footage_and_a_damaged_report_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_folder(room(), tmp_path / "result")
    other = write_footage(tmp_path / "other.avi", width=400)
    assert main(["view", str(tmp_path / "result"), "--footage", str(other)]) == 2
    assert_error(capsys.readouterr(), "400x270")
    (tmp_path / "result" / "report.html").write_text("<html>")
    assert main(["view", str(tmp_path / "result")]) == 2
    assert_error(capsys.readouterr(), "report.html is damaged: a report without data")
