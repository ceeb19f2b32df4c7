"""The footage behind a scene: a movie, or a numbered sequence of images."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from factorsfm.export.shot import Shot
from factorsfm.frames.folders import list_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.numbering import missing_numbers
from factorsfm.frames.photographs import in_format_of
from factorsfm.frames.reading import read_frames
from factorsfm.frames.sequences import numbered_names, sequence_numbers
from factorsfm.frames.unordered import read_images
from factorsfm.result.reconstruction import FrameResult
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)


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
    """The movie file or the sequence of images behind the scene.

    Raises:
        InputError: the user gave a folder whose images are not a numbered sequence.
    """
    path = shot.footage
    if path is None:
        said = shot.reconstruction.options.get("source")
        if isinstance(said, str) and Path(said).is_absolute():
            logger.warning("the footage %s is not where it was, and no plate is written; --footage says where", said)
        return None
    if path.is_file():
        return path.absolute()
    try:
        return image_sequence(path)
    except InputError as error:
        if shot.options.footage is not None:
            raise
        logger.warning("%s; they are left out", error)
        return None


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
    raise InputError(f"the images in {folder} are not numbered alike, as film tools expect it of a sequence")


def frames_of(shot: Shot, frames: Iterable[FrameResult]) -> Iterator[Frame]:
    """The images of some frames of the result, in order, from its footage; photographs as they were solved.

    Raises:
        InputError: while iterating, if the footage has no such frame, or another size.
    """
    assert shot.footage is not None
    wanted = [(frame, frame.index + shot.numbering.shift) for frame in frames]
    are_photographs = bool(shot.reconstruction.options.get("unordered"))
    images = _read(shot, slice(wanted[0][1], wanted[-1][1] + 1), photographs=are_photographs)
    for frame, index in wanted:
        found = next((image for image in images if image.index == index), None)
        if found is None:
            raise InputError(f"{shot.footage} has no frame {index}; it is not the shot of this result")
        camera = shot.reconstruction.camera_of(frame)
        if are_photographs:
            found = replace(found, image=in_format_of(camera, found.image))
        height, width = found.image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"frame {index} of {shot.footage} has {width}x{height} pixels, "
                f"the result {camera.width}x{camera.height}"
            )
        yield found


def _read(shot: Shot, part: slice, *, photographs: bool) -> Iterator[Frame]:
    assert shot.footage is not None
    if not photographs:
        return read_frames(shot.footage, part, fields=shot.fields)
    return (image for image in read_images(shot.footage, part) if isinstance(image, Frame))
