"""Output that appears when it is complete: a file or a folder, all of it or nothing."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from factorsfm.support.errors import InputError
from factorsfm.support.program import PROGRAM


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A file to write; it takes its place, also that of an earlier file, when the block ends without an error.

    Raises:
        InputError: it cannot be written.
    """
    if path.is_dir():
        raise InputError(f"the output {path} is a folder; this format is one file")
    with _temporary_beside(path) as folder:
        yield folder / path.name
        (folder / path.name).replace(path)


@contextmanager
def complete_folder(path: Path) -> Iterator[Path]:
    """A folder to write into; it takes its place when the block ends without an error.

    A folder that exists is accepted if it holds nothing but files of the same names: an earlier export.

    Raises:
        InputError: it cannot be written, or it holds something else.
    """
    path = path.absolute()
    if path.exists() and not path.is_dir():
        raise InputError(f"the output {path} is a file; this format is a folder")
    with _temporary_beside(path) as temporary:
        folder = temporary / path.name  # a plain mkdir honours the umask, the temporary folder does not
        folder.mkdir()
        yield folder
        if path.exists():
            _replace_content(path, folder)
        else:
            folder.rename(path)


def _replace_content(path: Path, new: Path) -> None:
    entries = {entry.relative_to(new): entry for entry in sorted(new.rglob("*"))}
    present = [entry for entry in path.rglob("*") if entry not in new.parents and not entry.is_relative_to(new)]
    others = {entry.relative_to(path) for entry in present} - set(entries)
    if others:
        raise InputError(f"the output folder {path} holds something else ({min(others)}); choose a new folder")
    for name, entry in entries.items():
        if entry.is_dir():
            (path / name).mkdir(exist_ok=True)
        else:
            entry.replace(path / name)


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    # Inside a folder that exists, since that may be a mount point or the working directory.
    place = path if path.is_dir() else path.absolute().parent
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{PROGRAM}-", dir=place) as folder:
            yield Path(folder)
    except OSError as error:
        raise InputError(f"cannot write the output {path}: {error.strerror or error}") from error
