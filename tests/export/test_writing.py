"""Folders of exports that are written again: whatever happened before, and whatever else lies in them."""

import os
from pathlib import Path

import pytest

from factorsfm.export import export
from factorsfm.report.result_folder import write_folder
from tests.exact_result import FILES, build
from tests.report.test_result_folder import KILLED, in_a_process

COLMAP = {"cameras.txt", "images.txt", "points3D.txt"}


def kill(monkeypatch: pytest.MonkeyPatch, writer: str, path: Path, format: str) -> None:
    """Kill an export when a function is called with which it writes."""
    with monkeypatch.context() as patch:
        patch.setattr(f"factorsfm.export.{writer}", lambda *_: os._exit(KILLED))
        assert in_a_process(lambda: export(build(), path, format=format)) == KILLED


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("earlier", [False, True])
def test_killed_while_it_writes_into_a_folder_the_next_export_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    if earlier:
        export(build(), tmp_path, format="colmap")
    before = names(tmp_path)
    for _ in range(2):
        kill(monkeypatch, "colmap._point_lines", tmp_path, "colmap")
    assert before < names(tmp_path)
    export(build(), tmp_path, format="colmap")
    assert names(tmp_path) == COLMAP


def test_killed_beside_an_empty_folder_s_files_it_still_counts_as_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill(monkeypatch, "trajectory._write_lines", tmp_path / "path.txt", "tum")
    (left,) = names(tmp_path)
    assert left.startswith(".factorsfm-")
    export(build(), tmp_path, format="colmap")
    assert names(tmp_path) == COLMAP | {left}  # it may be of a program that still runs
    for name in COLMAP:
        (tmp_path / name).unlink()
    write_folder(build(), tmp_path)
    assert names(tmp_path) == FILES | {left}
