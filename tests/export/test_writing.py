"""Folders of exports that are written again: whatever happened before, and whatever else lies in them."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from factorsfm.export import ExportOptions, export
from factorsfm.report.result_folder import write_folder
from factorsfm.support.errors import InputError
from tests.exact_result import FILES, build
from tests.export_problems import noise_images
from tests.exported_files import exported
from tests.report.test_result_folder import KILLED, Interfering, in_a_process

COLMAP = {"cameras.txt", "images.txt", "points3D.txt"}


def kill(monkeypatch: pytest.MonkeyPatch, writer: str, path: Path, format: str) -> None:
    """Kill an export when a function is called with which it writes."""
    with monkeypatch.context() as patch:
        patch.setattr(f"factorsfm.export.{writer}", lambda *_: os._exit(KILLED))
        assert in_a_process(lambda: export(build(), path, format=format)) == KILLED


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


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
    assert exported(tmp_path) == COLMAP


def test_killed_beside_an_empty_folder_s_files_it_still_counts_as_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill(monkeypatch, "trajectory._write_lines", tmp_path / "path.txt", "tum")
    (left,) = names(tmp_path)
    assert left.startswith(".factorsfm-")
    export(build(), tmp_path, format="colmap")
    assert names(tmp_path) == COLMAP | {".factorsfm", left}  # it may be of a program that still runs
    for name in COLMAP | {".factorsfm"}:
        (tmp_path / name).unlink()
    write_folder(build(), tmp_path)
    assert names(tmp_path) == FILES | {left}


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return noise_images(tmp_path / "shot", 21)


def long(shot: Path, out: Path) -> None:
    """Six frames and masks."""
    (shot.parent / "masks").mkdir(exist_ok=True)
    for k in range(21):
        (shot.parent / "masks" / f"{k:06d}.png").write_bytes((shot / "shot.1001.png").read_bytes())
    options = ExportOptions(footage=shot, masks=shot.parent / "masks")
    export(build(), out, format="nerfstudio", options=options)


def short(shot: Path, out: Path) -> None:
    """Three frames without masks, of other names."""
    result = build(frames=3, unregistered=())
    for frame in result.frames:
        frame.name = f"other {frame.index}.jpg"
    export(result, out, format="nerfstudio", options=ExportOptions(footage=shot))


@pytest.fixture
def fresh(tmp_path: Path, shot: Path) -> dict[Callable[[Path, Path], None], dict[str, bytes]]:
    """What both write into a folder that is new."""
    found = {}
    for write in (long, short):
        write(shot, tmp_path / write.__name__)
        found[write] = contents(tmp_path / write.__name__)
    return found


def test_an_export_replaces_one_of_other_files(tmp_path: Path, shot: Path, fresh: dict) -> None:
    assert exported(tmp_path / "long") == {"transforms.json", "points.ply", "images", "masks"}
    assert exported(tmp_path / "short") == {"transforms.json", "points.ply", "images"}
    assert not fresh[long].keys() & fresh[short].keys() - {".factorsfm", "transforms.json", "points.ply"}
    for write in (long, short, long):
        write(shot, tmp_path / "out")
        assert contents(tmp_path / "out") == fresh[write]


@pytest.mark.parametrize("place", ["mine.txt", "images/mine.png", "masks/of/mine", ".mine"])
def test_what_an_export_has_not_written_is_not_replaced(tmp_path: Path, shot: Path, fresh: dict, place: str) -> None:
    out = tmp_path / "out"
    long(shot, out)
    (out / place).parent.mkdir(exist_ok=True)
    (out / place).write_text("precious")
    with pytest.raises(InputError, match=rf"out holds something else \({place[:8]}.*\); choose a new folder"):
        short(shot, out)
    assert contents(out) == {**fresh[long], place: b"precious"}
    (out / place).unlink()
    if place == "masks/of/mine":
        (out / "masks/of").rmdir()
    short(shot, out)
    assert contents(out) == fresh[short]


@pytest.mark.parametrize("said", [None, "", "[]", '{"format": "nerfstudio"}', '{"format": "colmap", "entries": []}'])
def test_files_of_the_same_names_are_not_replaced_without_a_list(tmp_path: Path, shot: Path, said: str | None) -> None:
    out = tmp_path / "out"
    short(shot, out)
    if said is None:
        (out / ".factorsfm").unlink()
    else:
        (out / ".factorsfm").write_text(said)
    before = contents(out)
    with pytest.raises(InputError, match=r"out holds something else \(images\); choose a new folder"):
        short(shot, out)
    assert contents(out) == before


def test_an_export_of_another_format_is_not_replaced(tmp_path: Path) -> None:
    export(build(), tmp_path, format="colmap")
    before = contents(tmp_path)
    for format in ("colmap-binary", "nuke", "lens"):
        with pytest.raises(InputError, match=r"holds something else \(cameras.txt\)"):
            export(build(), tmp_path, format=format)
    assert contents(tmp_path) == before


def test_what_comes_into_the_folder_meanwhile_is_not_replaced(
    tmp_path: Path, shot: Path, fresh: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    long(shot, out)
    monkeypatch.setattr("factorsfm.export.nerfstudio.write_ply", lambda *_: (out / "images" / "mine").touch())
    with pytest.raises(InputError, match=r"holds something else \(images/mine\)"):
        short(shot, out)
    assert contents(out) == {**fresh[long], "images/mine": b""}


def test_killed_or_failing_at_any_step_of_an_exchange(
    tmp_path: Path, shot: Path, fresh: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error leaves the earlier export; a killed program a folder into which the next export goes."""
    out, interfering = tmp_path / "out", Interfering(monkeypatch, lambda: os._exit(KILLED))
    long(shot, out)
    steps = interfering.count(lambda folder: short(shot, folder), out)
    assert steps == 9  # four entries out, three in, and the list before and after
    for step in range(steps):
        long(shot, out)
        interfering.countdown = step
        assert in_a_process(lambda: short(shot, out)) == KILLED
        interfering.countdown = 1_000_000
        for write in (short, long):
            write(shot, out)
            assert contents(out) == fresh[write]

    def fail() -> None:
        raise OSError(5, "Input/output error")

    interfering = Interfering(monkeypatch, fail)
    for step in range(steps):
        interfering.countdown = step
        with pytest.raises(InputError, match="Input/output error"):
            short(shot, out)
        assert contents(out) == fresh[long]


def test_an_error_leaves_an_empty_folder_empty(tmp_path: Path, shot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise OSError(5, "Input/output error")

    (tmp_path / "out").mkdir()
    interfering = Interfering(monkeypatch, fail)
    for step in range(5):
        interfering.countdown = step
        with pytest.raises(InputError, match="Input/output error"):
            short(shot, tmp_path / "out")
        assert names(tmp_path / "out") == set()


@pytest.mark.parametrize("name", ["new", "replaced", ".factorsfm"])
def test_a_folder_may_have_any_name(tmp_path: Path, name: str) -> None:
    for frames in (6, 4):
        result = replace(build(frames=frames), options={})
        export(result, tmp_path / name, format="colmap")
        assert exported(tmp_path / name) == COLMAP
