"""``factorsfm view``: the report in the browser, or where it is."""

from pathlib import Path

import pytest

from factorsfm.cli.main import main
from factorsfm.report.result_folder import write_failure, write_folder
from tests.command_line import assert_error
from tests.exact_result import build


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
