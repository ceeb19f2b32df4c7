"""The footage behind a scene: a movie, or a numbered sequence of images."""

from __future__ import annotations

import logging
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorsfm.export.shot import Shot
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_images, read_image
from factorsfm.frames.frame import Frame
from factorsfm.frames.numbering import missing_numbers
from factorsfm.frames.photographs import in_format_of
from factorsfm.frames.reading import read_frames
from factorsfm.frames.sequences import numbered_names, sequence_numbers
from factorsfm.frames.unordered import read_images
from factorsfm.frames.video import announced_frames, are_fields
from factorsfm.result.reconstruction import FrameResult
from factorsfm.support.errors import InputError
from factorsfm.support.first_few import first_few

logger = logging.getLogger(__name__)

_NAMED = 5  # stretches of frames in a warning


@dataclass(frozen=True, slots=True)
class Sequence:
    """Images ``folder / (prefix + number + suffix)`` for each number from `first` to `last`.

    Attributes:
        digits: the numbers are padded with zeros to this length.
        missing: the numbers in between that have no file, in words; empty without gaps.
    """

    folder: Path
    prefix: str
    digits: int
    suffix: str
    first: int
    last: int
    missing: str

    def file(self, number: int) -> Path:
        return self.folder / f"{self.prefix}{number:0{self.digits}d}{self.suffix}"

    @property
    def pattern(self) -> str:
        """The path with a placeholder in the style of printf."""
        return (self.folder / f"{self.prefix}%0{self.digits}d{self.suffix}").as_posix()


def background(shot: Shot) -> Path | Sequence | None:
    """The movie file or the sequence of images behind the scene; a warning names frames that it lacks.

    Raises:
        InputError: the user gave a movie that cannot be decoded or whose fields were solved, or a folder whose images
            are not a numbered sequence, or photographs of several sizes.
    """
    path = shot.footage
    if path is None:
        said = shot.reconstruction.options.get("source")
        if isinstance(said, str) and Path(said).is_absolute():
            logger.warning("the footage %s is not where it was, and no plate is written; --footage says where", said)
        return None
    try:
        found, held = _movie(path, shot.fields) if path.is_file() else _numbered(path)
        if isinstance(found, Sequence) and shot.are_photographs:
            _check_photographs(shot, found)
    except InputError as error:
        if shot.options.footage is not None:
            raise
        logger.warning("there is no plate: %s", error)
        return None
    warn_of_missing(shot, held)
    return found


def _movie(path: Path, fields: Fields) -> tuple[Path, range]:
    """A movie file, and the numbers of its frames."""
    if are_fields(path, fields):
        raise InputError(
            f"{path} is interlaced, and the result is of its fields, twice the frames of half the lines; the format "
            "undistorted writes plates of the fields"
        )
    return path.absolute(), range(announced_frames(path))


def _numbered(folder: Path) -> tuple[Sequence, range]:
    """The images in a folder, and the numbers from the first to the last."""
    sequence = image_sequence(folder)
    return sequence, range(sequence.first, sequence.last + 1)


def _check_photographs(shot: Shot, sequence: Sequence) -> None:
    """Refuse photographs that a film tool would show at other numbers, or in other sizes, than they were solved."""
    for frame in shot.in_footage:
        camera = shot.reconstruction.camera_of(frame)
        if sequence.file(frame.index).name != frame.name:
            raise InputError(
                f"the photographs in {sequence.folder} are counted from 0, which is {shot.in_footage[0].name}; a plate "
                "has the numbers of its files"
            )
        height, width = read_image(sequence.folder / frame.name).shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{frame.name} has {width}x{height} pixels and was solved as one of {camera.width}x{camera.height}; a "
                "plate has images of one size"
            )


def warn_of_missing(shot: Shot, held: Container[int]) -> None:
    """Log which frames of the result the footage lacks, in words; `held`: the numbers of its frames."""
    frames = shot.in_footage
    lacking = np.flatnonzero([frame.index + shot.numbering.shift not in held for frame in frames])
    if len(lacking):
        runs = np.split(lacking, np.flatnonzero(np.diff(lacking) > 1) + 1)
        ends = [[shot.first_frame + frames[k].index for k in (run[0], run[-1])] for run in runs]
        spans = [str(first) if first == last else f"{first} to {last}" for first, last in ends]
        logger.warning(
            "the footage %s has %d of the %d frames of the result; it lacks %s",
            shot.footage, len(frames) - len(lacking), len(frames), first_few(spans, _NAMED),
        )  # fmt: skip


def image_sequence(folder: Path) -> Sequence:
    """The numbered images in a folder; other files are ignored, and a warning names gaps in the numbers.

    Raises:
        InputError: there are no images, or their names differ in more than numbers of one length.
    """
    names = [path.name for path in list_images(folder)]
    if not names:
        raise InputError(f"the footage {folder} holds no images")
    numbers = sequence_numbers(names)
    parts = numbered_names(names)
    if numbers is not None and parts is not None:
        digits = len(parts[0].digits)
        padded = all(part.digits == f"{part.number:0{digits}d}" for part in parts)
        if padded and len({part.suffix for part in parts}) == 1:
            missing = missing_numbers(numbers)
            if missing:
                logger.warning("the images in %s have gaps: %s are missing", folder, missing)
            return Sequence(
                folder.absolute(), parts[0].prefix, digits, parts[0].suffix, numbers[0], numbers[-1], missing
            )
    raise InputError(
        f"the images in {folder} are not numbered alike, as film tools expect it of a sequence; the format undistorted "
        "writes plates that are"
    )


def frames_of(shot: Shot, frames: Iterable[FrameResult]) -> Iterator[Frame]:
    """The images of some frames of the result, in order, from its footage; photographs as they were solved.

    Raises:
        InputError: while iterating, if the footage has no such frame, or another size.
    """
    assert shot.footage is not None
    wanted = [(frame, frame.index + shot.numbering.shift) for frame in frames]
    images = _read(shot, slice(wanted[0][1], wanted[-1][1] + 1))
    for frame, index in wanted:
        found = next((image for image in images if image.index == index), None)
        if found is None:
            raise InputError(f"{shot.footage} has no frame {index}; it is not the shot of this result")
        camera = shot.reconstruction.camera_of(frame)
        if shot.are_photographs:
            found = replace(found, image=in_format_of(camera, found.image))
        height, width = found.image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"frame {index} of {shot.footage} has {width}x{height} pixels, "
                f"the result {camera.width}x{camera.height}"
            )
        yield found


def _read(shot: Shot, part: slice) -> Iterator[Frame]:
    assert shot.footage is not None
    if not shot.are_photographs:
        return read_frames(shot.footage, part, fields=shot.fields)
    return (image for image in read_images(shot.footage, part) if isinstance(image, Frame))
