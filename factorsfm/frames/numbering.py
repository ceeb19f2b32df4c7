"""The numbers of the frames of a folder: those of a numbered sequence are in its file names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from factorsfm.frames.folders import IMAGE_SUFFIXES, list_images, unread_images
from factorsfm.frames.name_times import times_in
from factorsfm.frames.sequences import is_negative, mixture, sequence_numbers
from factorsfm.support.errors import InputError
from factorsfm.support.first_few import first_few

_NAMED_GAPS = 5
_NAMED = 3  # files or folders in a message
_NESTED = ("*", "*/*", "*/*/*")  # how deep images are looked for that a folder itself does not hold


class FrameFile(NamedTuple):
    """An image of a shot, the number of its frame, and its time where the names are times (seconds)."""

    number: int
    path: Path
    time: float | None = None


def numbered_images(folder: Path) -> list[FrameFile]:
    """The images of a shot in order, with the numbers of its frames: those in the names of a sequence, else from 0.

    Raises:
        InputError: the folder holds no images, several sequences, other files beside a long one, or negative numbers.
    """
    paths = images_of(folder)
    names = [path.name for path in paths]
    refuse_mixture(folder, names)
    if (times := times_in(names)) is not None:
        timed = sorted(zip(times, paths, strict=True))
        return [FrameFile(k, path, time) for k, (time, path) in enumerate(timed)]
    numbers = sequence_numbers(names) or range(len(paths))
    return [FrameFile(number, path) for number, path in zip(numbers, paths, strict=True)]


def images_of(folder: Path) -> list[Path]:
    """As `list_images`.

    Raises:
        InputError: there are none.
    """
    paths = list_images(folder)
    if not paths:
        suffixes = ", ".join(sorted(suffix[1:] for suffix in IMAGE_SUFFIXES))
        unread = unread_images(folder)
        hint = f"; {first_few(unread, _NAMED)}: convert them" if unread else _where_images_are(folder)
        raise InputError(f"folder {folder} holds no images ({suffixes}){hint}")
    return paths


def _where_images_are(folder: Path) -> str:
    """The folders inside that hold images, in words, as data sets and cameras nest theirs."""
    for pattern in _NESTED:
        inside = [path for path in sorted(folder.glob(pattern)) if path.is_dir() and not path.name.startswith(".")]
        if found := [path.relative_to(folder).as_posix() for path in inside if list_images(path)]:
            return f"; folders inside do: {first_few(found, _NAMED)}"
    return ""


def refuse_mixture(folder: Path, names: Sequence[str]) -> None:
    """Refuse names of more than one sequence, of a long one and of others, or with negative numbers.

    Raises:
        InputError: they are.
    """
    refuse_negative(folder, names)
    if sequence_numbers(names) is None and (found := mixture(names)):
        raise InputError(f"folder {folder} holds {found}; a folder with one of them is expected")


def refuse_negative(folder: Path, names: Sequence[str]) -> None:
    """Refuse negative numbers of frames, as in plate.-0024.png: sorted by name, time would run backwards.

    Raises:
        InputError: there are some.
    """
    if found := next(filter(is_negative, names), None):
        raise InputError(
            f"folder {folder} holds frames with negative numbers ({found}); numbers from 0 on are expected"
        )


def sequence_of(source: object) -> list[int] | None:
    """Numbers of the frames of a folder that holds a numbered sequence; None for every other source."""
    if not (isinstance(source, str | Path) and Path(source).is_dir()):
        return None
    return sequence_numbers([path.name for path in list_images(Path(source))])


def first_number_of(source: object) -> int | None:
    """Number of the first frame of a folder that holds a numbered sequence; None for every other source."""
    numbers = sequence_of(source)
    return numbers[0] if numbers is not None else None


def chosen(images: list[FrameFile], frames: slice) -> list[FrameFile]:
    """The images whose numbers are in a range; the steps begin at the first number that is there.

    Args:
        frames: see `ranges.checked_range`.

    Raises:
        InputError: there is none.
    """
    first, last = images[0].number, images[-1].number
    start = max(frames.start, first)
    stop = last + 1 if frames.stop is None else frames.stop
    found = [image for image in images if image.number in range(start, max(stop, start), frames.step)]
    if not found:
        wanted = f"before number {stop}" if stop <= first else f"from number {frames.start} on"
        if first < stop <= last and first <= frames.start:
            wanted = f"with the numbers {frames.start} to {stop - 1}"
        raise InputError(f"{images[0].path.parent} holds no frames {wanted}; its frames are {first} to {last}")
    return found


def missing_numbers(numbers: Sequence[int]) -> str:
    """The gaps of a sequence in words, "1020 to 1024, 1031"; empty if its numbers have one step throughout."""
    steps = np.diff(np.asarray(numbers, np.int64))
    if not len(steps) or (steps == steps[0]).all():
        return ""
    step = int(steps.min())
    gaps = [(numbers[k] + step, numbers[k + 1] - step) for k in np.flatnonzero(steps > step).tolist()]
    said = [str(first) if first == last else f"{first} to {last}" for first, last in gaps[:_NAMED_GAPS]]
    return ", ".join(said) + (f" and {len(gaps) - _NAMED_GAPS} more gaps" if len(gaps) > _NAMED_GAPS else "")
