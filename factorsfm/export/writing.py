"""Files and folders that appear only when they are complete."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from factorsfm.support.errors import InputError
from factorsfm.support.output_files import kind_of, replaced_file
from factorsfm.support.program import PROGRAM

_TEMPORARY = f".{PROGRAM}-"  # begins the names of temporary folders
REPLACING = f"{_TEMPORARY}replacing-"  # of those in a folder whose entries are replaced


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
def complete_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder to write into; it moves to `path` when the block ends without an error.

    A folder that exists is accepted if all of its files have the names of new ones: an earlier export. Its entries are
    replaced one by one, since the folder may be a mount point or the working directory.

    Raises:
        InputError: it cannot be written, or it holds something else.
    """
    path = path.absolute()
    if (kind := kind_of(path)) not in (None, "a folder"):
        raise InputError(f"the output {path} is {kind}; this format is a folder")
    with _temporary_beside(path) as temporary:
        folder = temporary / path.name  # a plain mkdir honours the umask, the temporary folder does not
        folder.mkdir()
        yield folder
        if path.exists():
            _replace_content(path, folder, temporary / "replaced")
        else:
            folder.rename(path)


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


def rename_all(moves: Iterable[tuple[Path, Path]]) -> None:
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


def exchanged(directory: Path, new: Path, replaced: Path, names: Iterable[str]) -> list[tuple[Path, Path]]:
    """The renames that move entries of `new` to `directory`, and earlier entries of the same names to `replaced`."""
    moves = [((directory / name, replaced / name), (new / name, directory / name)) for name in names]
    return [move for pair in moves for move in pair if os.path.lexists(move[0])]


def _replace_content(path: Path, new: Path, replaced: Path) -> None:
    entries = {entry.relative_to(new) for entry in new.rglob("*")}
    present = {inner for entry in entries_of(path) for inner in (entry, *entry.rglob("*"))}
    if others := {entry.relative_to(path) for entry in present} - entries:
        raise InputError(f"the output folder {path} holds something else ({min(others)}); choose a new folder")
    replaced.mkdir()
    rename_all(exchanged(path, new, replaced, sorted(entry.name for entry in new.iterdir())))


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    try:
        with temporary_folder(path) as folder:
            yield folder
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot write the output {path}: {error.strerror or error}")
