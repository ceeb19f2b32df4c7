"""Files and folders that appear only when they are complete."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json, typed
from factorsfm.support.json_text import json_text
from factorsfm.support.output_files import kind_of, replaced_file
from factorsfm.support.program import PROGRAM

_TEMPORARY = f".{PROGRAM}-"  # begins the names of temporary folders
REPLACING = f"{_TEMPORARY}replacing-"  # of those in a folder whose entries are replaced
_LIST = f".{PROGRAM}"  # name of the list; without a suffix, by which trainers look for files


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write; the file moves to `path` when the block ends without an error.

    An earlier file is replaced; of a link, the file that it leads to.

    Raises:
        InputError: it cannot be written, or is something else than a file.
    """
    if path.is_dir():
        raise InputError(f"the output {path} is a folder; this format is one file")
    try:
        target = replaced_file(path)
    except OSError as error:
        raise _unwritable(path, error) from error
    with _temporary_beside(target) as folder:
        yield folder / path.name
        (folder / path.name).replace(target)


@contextmanager
def complete_folder(path: Path, format: str) -> Iterator[Path]:
    """Yields a temporary folder to write into; it moves to `path` when the block ends without an error.

    A folder that exists is accepted if it is empty, or holds nothing but an earlier output of the same format, which
    has left a list of its entries in it. They are replaced one by one, since the folder may be a mount point or the
    working directory.

    Raises:
        InputError: it cannot be written, or it holds something else.
    """
    path = path.absolute()
    if (kind := kind_of(path)) not in (None, "a folder"):
        raise InputError(f"the output {path} is {kind}; this format is a folder")
    with _temporary_beside(path) as temporary:
        _earlier_entries(path, format)  # before the work
        folder = temporary / "new"  # a plain mkdir honours the umask, the temporary folder does not
        folder.mkdir()
        yield folder
        entries = _all_in(folder)
        _write_list(folder, format, entries)
        if path.exists():
            entries |= _earlier_entries(path, format)
            names = {entry.partition("/")[0] for entry in entries}
            meanwhile = _write_list(temporary, format, entries)
            replace_entries(path, folder, temporary / "replaced", names, _LIST, meanwhile)
        else:
            folder.rename(path)


@dataclass(frozen=True, slots=True)
class _List:
    """What the folder of an output says of itself: its entries, with those of its folders."""

    format: str
    entries: list[str]


def _write_list(folder: Path, format: str, entries: set[str]) -> Path:
    text = json_text({"program": PROGRAM, "format": format, "entries": sorted(entries)})
    (folder / _LIST).write_text(text, encoding="utf-8")
    return folder / _LIST


def _earlier_entries(path: Path, format: str) -> set[str]:
    """What a folder holds of an earlier output, without its list; nothing if there is no folder.

    Raises:
        InputError: it holds something else.
    """
    if not path.is_dir():
        return set()
    try:
        said = typed(_List, read_json(path / _LIST, "list"), "list")
    except InputError:
        said = _List(format, [])
    present = _all_in(path)
    if others := present - ({*said.entries} if said.format == format else set()):
        raise InputError(f"the output folder {path} holds something else ({min(others)}); choose a new folder")
    return present


def _all_in(folder: Path) -> set[str]:
    """All entries of a folder and its folders, without the list, by their paths in it."""
    found = (inner for entry in entries_of(folder) for inner in (entry, *entry.rglob("*")))
    return {inner.relative_to(folder).as_posix() for inner in found} - {_LIST}


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder from which a file or folder can be renamed to `path`, or entries into that folder.

    It is beside the path, or inside of a folder that exists, since that may be a mount point or the working directory.
    What earlier ones have left inside, of a program that was killed, goes when the block ends without an error.

    Raises:
        OSError: it cannot be made.
    """
    inside = path.is_dir()
    place = path if inside else path.absolute().parent
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=REPLACING if inside else _TEMPORARY, dir=place) as folder:
        yield Path(folder)
    if inside:
        for left in path.glob(f"{REPLACING}*"):
            shutil.rmtree(left, ignore_errors=True)


def entries_of(folder: Path) -> list[Path]:
    """What is in a folder, without what a program has left there that was killed."""
    return [path for path in folder.iterdir() if not path.name.startswith(_TEMPORARY)]


def _rename_all(moves: Iterable[tuple[Path, Path]]) -> None:
    """Rename paths one by one, each from the first to the second; after an error, all renames are undone."""
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            done.append((source, target))
            source.replace(target)
    except BaseException:
        for source, target in reversed(done):
            if not os.path.lexists(source):
                target.replace(source)
        raise


def replace_entries(
    directory: Path, new: Path, replaced: Path, names: Iterable[str], teller: str, meanwhile: Path
) -> None:
    """Exchange entries of a folder one by one, and last the file that tells what it holds; an error takes all back.

    Args:
        new: folder of the new entries; replaced: folder to make for the earlier ones.
        names: of the entries, new and earlier; teller: name of the file that tells what the folder holds.
        meanwhile: what takes its place as long as entries are exchanged, and stays where the program is killed.
    """
    told, before = directory / teller, replaced / teller
    replaced.mkdir()
    if told.exists():
        shutil.copyfile(told, before)
    moves = [*_exchanged(directory, new, replaced, sorted({*names} - {teller})), (new / teller, told)]
    try:
        meanwhile.replace(told)
        _rename_all(moves)
    except BaseException:
        if not all(os.path.lexists(source) for source, _ in moves):
            raise  # not everything could be undone
        if before.exists():
            before.replace(told)
        else:
            told.unlink(missing_ok=True)
        raise


def _exchanged(directory: Path, new: Path, replaced: Path, names: Iterable[str]) -> list[tuple[Path, Path]]:
    """The renames that move entries of `new` to `directory`, and earlier entries of the same names to `replaced`."""
    moves = [((directory / name, replaced / name), (new / name, directory / name)) for name in names]
    return [move for pair in moves for move in pair if os.path.lexists(move[0])]


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    try:
        with temporary_folder(path) as folder:
            yield folder
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot write the output {path}: {error.strerror or error}")
