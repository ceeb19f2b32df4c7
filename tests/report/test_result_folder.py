"""One result replaced by another: whatever happens in between, no mixture of the two is taken for a result."""

import os
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import pytest

from factorsfm.batch.plan import Job, Method, Video
from factorsfm.cli.main import main
from factorsfm.report.result_folder import check_directory, remove_result, write_failure, write_folder
from factorsfm.result.reading import read_result
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from tests.exact_result import FILES, build

Write = Callable[[Path], None]
EARLIER, NEW = "earlier", "new"
KILLED = 9
NEVER = 1_000_000


def result(name: str, parts: int, folder: Path) -> Reconstruction:
    """Of a job of a batch, with further parts; `note` tells whose it is."""
    options = {"job": job(name, folder).to_dict()}
    made = replace(build(points=9), notes=[name], options=options)
    made.others = [replace(build(points=8), notes=[f"{name} {k}"]) for k in range(2, parts + 1)]
    return made


def job(name: str, folder: Path) -> Job:
    return Job(Video(folder / f"{name}.mp4", name, 1, 1), range(6), Method(), folder)


def write_new(folder: Path) -> None:
    write_folder(result(NEW, 2, folder), folder)


def write_reason(folder: Path) -> None:
    write_failure(folder, NEW, options={"job": job(NEW, folder).to_dict()})


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An earlier result of three parts, with files of the user."""
    folder = tmp_path / "out"
    write_folder(result(EARLIER, 3, folder), folder)
    (folder / "picture.png").write_text("drawn by the demonstration")
    (folder / "mine").mkdir()
    (folder / "mine" / "notes.txt").write_text("precious")
    return folder


class Interfering:
    """Lets `act` happen instead of the rename with a number."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
        self.countdown = NEVER
        rename = Path.replace

        def renamed(source: Path, target: Path) -> Path:
            self.countdown -= 1
            if self.countdown == -1:
                act()
            return rename(source, target)

        monkeypatch.setattr(Path, "replace", renamed)

    def count(self, write: Write, folder: Path) -> int:
        """How many renames there are."""
        self.countdown = NEVER
        write(folder)
        return NEVER - self.countdown


def steps(folder: Path, write: Write, interfering: Interfering) -> int:
    """The renames with which another folder like this one is replaced."""
    other = folder.parent / "other"
    write_folder(result(EARLIER, 3, other), other)
    (other / "picture.png").touch()
    return interfering.count(write, other)


@pytest.mark.parametrize(("write", "renames"), [(write_new, 14), (write_reason, 10)])
@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()])
def test_an_error_at_any_step_leaves_the_earlier_result(
    folder: Path, monkeypatch: pytest.MonkeyPatch, write: Write, renames: int, error: BaseException
) -> None:
    def fail() -> None:
        raise error

    interfering, before = Interfering(monkeypatch, fail), contents(folder)
    assert steps(folder, write, interfering) == renames
    for step in range(renames):
        interfering.countdown = step
        with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else InputError):
            write(folder)
        assert contents(folder) == before
        assert len(list(folder.parent.iterdir())) == 2


def test_what_cannot_be_undone_says_that_it_is_incomplete(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    next_failure = cycle((0, NEVER))  # the first step back fails, too

    def fail() -> None:
        interfering.countdown = next(next_failure)
        raise OSError(5, "Input/output error")

    interfering = Interfering(monkeypatch, fail)
    for step in range(1, steps(folder, write_new, interfering)):
        interfering.countdown = step
        with pytest.raises(InputError, match="Input/output error"):
            write_new(folder)
        interfering.countdown = NEVER
        assert not job(EARLIER, folder).is_done()
        with pytest.raises(InputError, match="out is incomplete"):
            read_result(folder)
        write_folder(result(EARLIER, 3, folder), folder)
        (folder / "picture.png").touch()
    assert (folder / "mine" / "notes.txt").read_text() == "precious"


@pytest.mark.parametrize("write", [write_new, write_reason])
def test_killed_at_any_step_the_folder_is_whole_or_says_that_it_is_incomplete(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Write
) -> None:
    interfering = Interfering(monkeypatch, lambda: os._exit(KILLED))
    found = []
    for step in range(steps(folder, write, interfering)):
        write_folder(result(EARLIER, 3, folder), folder)
        (folder / "picture.png").touch()
        interfering.countdown = step
        assert in_a_process(lambda: write(folder)) == KILLED
        interfering.countdown = NEVER
        assert (folder / "mine" / "notes.txt").read_text() == "precious"
        check_directory(folder)  # it can be replaced
        done = [name for name in (EARLIER, NEW) if job(name, folder).is_done()]
        found.append(done)
        if done == [EARLIER]:
            assert [part.notes for part in parts_of(folder)] == [[EARLIER], ["earlier 2"], ["earlier 3"]]
            continue
        assert done == []
        with pytest.raises(InputError, match=r"out is incomplete: the program was stopped while it replaced"):
            read_result(folder)
        for part in folder.glob("part-*"):  # each is whole
            assert read_result(part).notes[0].endswith(part.name[-1])
        assert main(["export", str(folder), "--format", "ply", "--output", str(tmp_path / "points.ply")]) == 2
        assert not (tmp_path / "points.ply").exists()
    assert found == [[EARLIER]] + [[]] * (len(found) - 1)
    write_folder(result(NEW, 1, folder), folder)
    assert job(NEW, folder).is_done()
    assert [part.notes for part in parts_of(folder)] == [[NEW]]
    assert {path.name for path in folder.iterdir()} == FILES | {"mine"}  # nothing is left of those that were killed


def test_a_result_is_removed_without_what_is_not_its_own(folder: Path, tmp_path: Path) -> None:
    remove_result(folder)
    assert contents(folder) == {"mine/notes.txt": b"precious"}
    write_folder(result(EARLIER, 3, folder), tmp_path / "other")
    remove_result(tmp_path / "other")
    assert {path.name for path in tmp_path.iterdir()} == {"out"}


def test_killed_while_it_removes_a_result_it_leaves_one_that_says_that_it_is_incomplete(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interfering = Interfering(monkeypatch, lambda: os._exit(KILLED))
    for step in range(1, 8):  # of seven entries
        interfering.countdown = step
        assert in_a_process(lambda: remove_result(folder)) == KILLED
        interfering.countdown = NEVER
        with pytest.raises(InputError, match="out is incomplete"):
            read_result(folder)
        write_folder(result(EARLIER, 3, folder), folder)
        (folder / "picture.png").touch()
    assert (folder / "mine" / "notes.txt").read_text() == "precious"


def in_a_process(act: Callable[[], None]) -> int:
    """Exit status of a copy of this process that does something."""
    if (child := os.fork()) == 0:
        try:
            act()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def parts_of(folder: Path) -> list[Reconstruction]:
    whole = read_result(folder)
    return [whole, *whole.others]


def test_killed_while_it_writes_into_an_empty_folder_it_leaves_one_that_counts_as_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factorsfm.report.result_folder.write_ply", lambda *_: os._exit(KILLED))
    assert in_a_process(lambda: write_folder(build(), tmp_path)) == KILLED
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.undo()
    write_folder(build(), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_footage_at_the_place_of_a_part_stays(folder: Path) -> None:
    for name in ("part-002", "mine"):
        (folder / name / "shot.mp4").write_text("footage")
    lost = replace(build(points=9), options={"source": str(folder / "part-002" / "shot.mp4")})
    for call in (
        lambda: lost.write(folder),
        lambda: check_directory(folder, folder / "part-002" / "shot.mp4"),
        lambda: write_failure(folder, NEW, options=lost.options),
    ):
        with pytest.raises(InputError, match="part-002 would overwrite the footage"):
            call()
    replace(lost, options={"source": str(folder / "mine" / "shot.mp4")}).write(folder)
    assert (folder / "mine" / "shot.mp4").read_text() == "footage"


def test_a_folder_of_the_user_is_not_taken_for_a_part(folder: Path) -> None:
    (folder / "part-004").mkdir()
    (folder / "part-004" / "precious.txt").write_text("x")
    before = contents(folder)
    for call in (check_directory, write_new, write_reason):
        with pytest.raises(InputError, match="holds part-004, which is no part of an earlier result"):
            call(folder)
    assert contents(folder) == before


def test_an_earlier_result_goes_with_all_of_its_parts(folder: Path) -> None:
    write_new(folder)
    assert {path.name for path in folder.iterdir()} == FILES | {"mine", "part-002"}
    assert [part.notes for part in parts_of(folder)] == [[NEW], ["new 2"]]
