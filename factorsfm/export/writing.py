"""Output that appears when it is complete: a file or a folder, all of it or nothing."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from factorsfm.errors import InputError
from factorsfm.summary import PROGRAM


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
    if path.exists() and not path.is_dir():
        raise InputError(f"the output {path} is a file; this format is a folder")
    with _temporary_beside(path) as temporary:
        folder = temporary / path.name  # a plain mkdir honours the umask, the temporary folder does not
        folder.mkdir()
        yield folder
        if not path.exists():
            folder.rename(path)
            return
        entries = sorted(folder.rglob("*"))
        others = {p.relative_to(path) for p in path.rglob("*")} - {p.relative_to(folder) for p in entries}
        if others:
            raise InputError(f"the output folder {path} holds something else ({min(others)}); choose a new folder")
        for entry in entries:
            target = path / entry.relative_to(folder)
            if entry.is_dir():
                target.mkdir(exist_ok=True)
            else:
                entry.replace(target)


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    try:
        parent = path.absolute().parent
        parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{PROGRAM}-", dir=parent) as folder:
            yield Path(folder)
    except OSError as error:
        raise InputError(f"cannot write the output {path}: {error.strerror or error}") from error
