"""The result folder: written beside its place and moved there when it is complete."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from factorsfm.export.colmap import write_colmap
from factorsfm.export.ply import write_ply
from factorsfm.export.trajectory import write_trajectory
from factorsfm.report.page import failure_html, report_html
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.summary import failure_summary, part_name, summary
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import json_text
from factorsfm.support.program import PROGRAM

# Whatever an earlier result may have left; picture.png is drawn by the demo.
_ENTRIES = ("trajectory.tum", "colmap", "points.ply", "report.html", "picture.png", "summary.json")


def write_folder(reconstruction: Reconstruction, directory: str | Path) -> None:
    """Write trajectory.tum, colmap/, points.ply, summary.json and report.html; all of them or nothing.

    Other parts of an image set become folders in it, part-002 and so on. The files of an earlier result are replaced;
    other files in such a folder stay.

    Raises:
        InputError: the directory cannot be written, or holds something else than an earlier result.
    """
    with _complete_or_nothing(Path(directory)) as folder:
        _write_files(reconstruction, folder)
        for number, other in enumerate(reconstruction.others, 2):
            (folder / part_name(number)).mkdir()
            _write_files(other, folder / part_name(number))


def _write_files(reconstruction: Reconstruction, folder: Path) -> None:
    write_trajectory(reconstruction, folder / "trajectory.tum")
    write_colmap(reconstruction, folder / "colmap")
    write_ply(reconstruction, folder / "points.ply")
    (folder / "report.html").write_text(report_html(reconstruction), encoding="utf-8")
    (folder / "summary.json").write_text(json_text(summary(reconstruction)), encoding="utf-8")


def write_failure(
    directory: str | Path,
    reason: str,
    frames: Sequence[FrameResult] = (),
    options: Mapping[str, Any] | None = None,
    seconds: Mapping[str, float] | None = None,
) -> None:
    """Write a summary.json and a report.html that say why the shot cannot be reconstructed; an earlier result goes.

    Raises:
        InputError: the directory cannot be written, or holds something else than an earlier result.
    """
    with _complete_or_nothing(Path(directory)) as folder:
        options, seconds = options or {}, seconds or {}
        (folder / "report.html").write_text(failure_html(reason, frames, options, seconds), encoding="utf-8")
        content = failure_summary(reason, frames, options, seconds)
        (folder / "summary.json").write_text(json_text(content), encoding="utf-8")


def check_directory(directory: str | Path) -> None:
    """Find out before the long work whether a result can be written here; changes nothing.

    Raises:
        InputError: the directory cannot be written, or holds something else than an earlier result.
    """
    directory = Path(directory)
    try:
        if directory.exists() and any(directory.iterdir()) and not is_earlier_result(directory):
            raise InputError(
                f"the output folder {directory} is not empty and holds no earlier factorsfm result; "
                "choose a new or empty folder"
            )
        existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
        with tempfile.TemporaryDirectory(prefix=f".{PROGRAM}-", dir=existing):
            pass
    except OSError as error:
        raise _unwritable(directory, error) from error


@contextmanager
def _complete_or_nothing(directory: Path) -> Iterator[Path]:
    """A folder to write into; its content becomes `directory` when the block ends without an error."""
    check_directory(directory)
    existed = directory.exists()
    try:
        # Inside a directory that exists, since that may be a mount point or the working directory.
        place = directory if existed else directory.absolute().parent
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{PROGRAM}-", dir=place) as temporary:
            folder = Path(temporary) / "result"  # a plain mkdir honours the umask, mkdtemp does not
            folder.mkdir()
            yield folder
            if existed:
                _replace_entries(folder, directory)
            else:
                folder.rename(directory)
    except OSError as error:
        raise _unwritable(directory, error) from error


def _replace_entries(new: Path, directory: Path) -> None:
    """Swap the files one by one; summary.json, which marks a result, goes last."""
    parts = {path.name for folder in (directory, new) for path in folder.glob("part-*") if is_earlier_result(path)}
    for name in (*sorted(parts), *_ENTRIES):
        old = directory / name
        if old.is_dir():
            shutil.rmtree(old)
        elif not (new / name).exists():
            old.unlink(missing_ok=True)
        if (new / name).exists():
            (new / name).replace(old)


def is_earlier_result(directory: Path) -> bool:
    """Whether a folder holds a result, or the reason why there is none."""
    try:
        content = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("program") == PROGRAM


def _unwritable(directory: Path, error: OSError) -> InputError:
    return InputError(f"cannot write to the output folder {directory}: {error.strerror or error}")
