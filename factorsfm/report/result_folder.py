"""The result folder: written beside its place, and moved there when it is complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from factorsfm.export.colmap import write_colmap
from factorsfm.export.ply import write_ply
from factorsfm.export.trajectory import write_trajectory
from factorsfm.export.writing import REPLACING, entries_of, replace_entries, temporary_folder
from factorsfm.frames.targets import spare_footage
from factorsfm.report.page import failure_html, report_html
from factorsfm.result.image_sources import footage_of
from factorsfm.result.moving import moving_json
from factorsfm.result.objects import objects_json
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.summary import failure_summary, incomplete_summary, part_name, summary
from factorsfm.result.tracks_file import write_tracks
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json
from factorsfm.support.json_text import json_text
from factorsfm.support.output_files import kind_of
from factorsfm.support.program import PROGRAM

# Whatever an earlier result may have left besides summary.json; picture.png is drawn by the demo, view.html by `view`.
_ENTRIES = (
    "trajectory.tum", "colmap", "points.ply", "objects.json", "moving.json", "tracks.npz", "report.html",
    "view.html", "picture.png",
)  # fmt: skip
_SUMMARY = "summary.json"
_PARTS = "part-[0-9][0-9][0-9]*"  # folders of the other parts of an image set


def write_folder(reconstruction: Reconstruction, directory: str | Path) -> None:
    """Write trajectory.tum, colmap/, points.ply, summary.json, report.html; objects.json where there are objects,
    moving.json where something moves by itself, and of a video tracks.npz.

    All of them or nothing.

    Other parts of an image set become folders in it, part-002 and so on. The files of an earlier result are replaced
    one by one, and other files in such a folder stay; a result that is incomplete, because the program was killed
    meanwhile, says so and can be replaced.

    Raises:
        InputError: the directory cannot be written, or holds something else than an earlier result.
    """
    with _complete_or_nothing(Path(directory), reconstruction.options) as folder:
        _write_files(reconstruction, folder)
        for number, other in enumerate(reconstruction.others, 2):
            (folder / part_name(number)).mkdir()
            _write_files(other, folder / part_name(number))


def _write_files(reconstruction: Reconstruction, folder: Path) -> None:
    write_trajectory(reconstruction, folder / "trajectory.tum")
    write_colmap(reconstruction, folder / "colmap")
    write_ply(reconstruction, folder / "points.ply")
    if reconstruction.objects:
        content = json_text(objects_json(reconstruction.objects), indent=None)
        (folder / "objects.json").write_text(content, encoding="utf-8")
    if reconstruction.moving is not None:
        content = json_text(moving_json(reconstruction.moving), indent=None)
        (folder / "moving.json").write_text(content, encoding="utf-8")
    if reconstruction.measured is not None:
        write_tracks(reconstruction.measured, folder / "tracks.npz")
    page = report_html(reconstruction, can_be_mended=reconstruction.measured is not None)
    (folder / "report.html").write_text(page, encoding="utf-8")
    (folder / _SUMMARY).write_text(json_text(summary(reconstruction)), encoding="utf-8")


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
    options, seconds = options or {}, seconds or {}
    with _complete_or_nothing(Path(directory), options) as folder:
        (folder / "report.html").write_text(failure_html(reason, frames, options, seconds), encoding="utf-8")
        content = failure_summary(reason, frames, options, seconds)
        (folder / _SUMMARY).write_text(json_text(content), encoding="utf-8")


def check_directory(directory: str | Path, *footage: object) -> None:
    """Find out before the long work whether a result can be written here; changes nothing.

    Args:
        footage: what must not be overwritten, see `spare_footage`.

    Raises:
        InputError: the directory cannot be written, holds something else than an earlier result, or footage at the
            place of its files.
    """
    directory = Path(directory)
    if (kind := kind_of(directory)) not in (None, "a folder"):
        raise InputError(f"cannot write to the output folder {directory}: it is {kind}")
    try:
        if directory.exists() and entries_of(directory) and not is_earlier_result(directory):
            raise InputError(
                f"the output folder {directory} is not empty and holds no earlier factorsfm result; "
                "choose a new or empty folder"
            )
        if foreign := {path.name for path in directory.glob(_PARTS)} - {*_parts(directory)}:
            raise InputError(
                f"the output folder {directory} holds {min(foreign)}, which is no part of an earlier result; "
                "choose another folder"
            )
        spare_footage([directory / name for name in (_SUMMARY, *_ENTRIES, *_parts(directory))], *footage)
        existing = next(p for p in (directory, *directory.absolute().parents) if p.exists())
        with tempfile.TemporaryDirectory(prefix=f".{PROGRAM}-", dir=existing):
            pass
    except OSError as error:
        raise _unwritable(directory, error) from error


@contextmanager
def _complete_or_nothing(directory: Path, options: Mapping[str, Any]) -> Iterator[Path]:
    """A folder to write into; its content becomes `directory` when the block ends without an error.

    Args:
        options: of the result, which name its footage.
    """
    check_directory(directory, *footage_of(options))
    existed = directory.exists()
    try:
        with temporary_folder(directory) as temporary:
            folder = temporary / "result"  # a plain mkdir honours the umask, the temporary folder does not
            folder.mkdir()
            yield folder
            if existed:
                names = {*_entries(directory), *(path.name for path in folder.iterdir())}
                replace_entries(directory, folder, temporary / "replaced", names, _SUMMARY, _incomplete(temporary))
            else:
                folder.rename(directory)
    except OSError as error:
        raise _unwritable(directory, error) from error


def remove_result(directory: Path) -> None:
    """Remove a result; its folder stays if it holds other files.

    Raises:
        InputError: it cannot be removed.
    """
    try:
        with tempfile.TemporaryDirectory(prefix=REPLACING, dir=directory) as temporary:
            _incomplete(Path(temporary)).replace(directory / _SUMMARY)
            for name in _entries(directory):
                (directory / name).replace(Path(temporary) / name)
            (directory / _SUMMARY).unlink()
        if not any(directory.iterdir()):
            directory.rmdir()
    except OSError as error:
        raise _unwritable(directory, error) from error


def _incomplete(temporary: Path) -> Path:
    """A summary that says that the result is incomplete, for as long as it is, also where the program is killed."""
    marker = temporary / "incomplete.json"
    marker.write_text(json_text(incomplete_summary()), encoding="utf-8")
    return marker


def _entries(directory: Path) -> list[str]:
    """Names of what is there of a result, without summary.json."""
    return [name for name in (*_ENTRIES, *_parts(directory)) if os.path.lexists(directory / name)]


def _parts(directory: Path) -> list[str]:
    """Names of the folders that other parts of an image set have in that of an earlier result."""
    return [path.name for path in directory.glob(_PARTS) if is_earlier_result(path)]


def is_earlier_result(directory: Path) -> bool:
    """Whether a folder holds a result, also an incomplete one, or the reason why there is none."""
    try:
        content = read_json(directory / _SUMMARY, "the summary")
    except InputError:
        return False
    return isinstance(content, dict) and content.get("program") == PROGRAM


def report_of(directory: Path) -> Path:
    """The report in a result folder, absolute.

    Raises:
        InputError: the folder holds no result, or one that is incomplete.
    """
    page = directory.absolute() / "report.html"
    if not (is_earlier_result(directory) and page.is_file()):
        raise InputError(f"{directory} holds no report of factorsfm; a folder that it has written is expected")
    return page


def _unwritable(directory: Path, error: OSError) -> InputError:
    return InputError(f"cannot write to the output folder {directory}: {error.strerror or error}")
