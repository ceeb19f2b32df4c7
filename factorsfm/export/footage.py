"""The footage behind a scene: a movie, or a numbered sequence of images."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path

from factorsfm.export.shot import Shot
from factorsfm.frames.folders import IMAGE_SUFFIXES
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

_NUMBERED = re.compile(r"(.*?)(\d+)(\.\w+)")


@dataclass(frozen=True, slots=True)
class Sequence:
    """Images ``folder / (prefix + number + suffix)`` for each number from `first` to `last`.

    Attributes:
        digits: the numbers are padded with zeros to this length.
    """

    folder: Path
    prefix: str
    digits: int
    suffix: str
    first: int
    last: int

    def file(self, number: int) -> Path:
        return self.folder / f"{self.prefix}{number:0{self.digits}d}{self.suffix}"

    @property
    def pattern(self) -> str:
        """The path with a placeholder in the style of printf."""
        return (self.folder / f"{self.prefix}%0{self.digits}d{self.suffix}").as_posix()


def background(shot: Shot) -> Path | Sequence | None:
    """The movie file or the sequence of images behind the scene; its first frame is frame 0 of the source.

    Raises:
        InputError: the user gave a folder whose images are not a numbered sequence.
    """
    path = shot.footage
    if path is None:
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
    """The numbered images in a folder; other files are ignored.

    Raises:
        InputError: there are no images, or their numbers have gaps, which film tools do not accept.
    """
    names = [path.name for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    matches = [_NUMBERED.fullmatch(name) for name in names]
    found = {(match[1], match[3]) for match in matches if match}
    numbers = sorted((int(match[2]), len(match[2])) for match in matches if match)
    if not names:
        raise InputError(f"the footage {folder} holds no images")
    first, digits = numbers[0] if numbers else (0, 0)
    without_gaps = [(number, max(digits, len(str(number)))) for number in range(first, first + len(names))]
    if None in matches or len(found) != 1 or numbers != without_gaps:
        raise InputError(f"the images in {folder} are not numbered without gaps, as film tools expect it of a sequence")
    ((prefix, suffix),) = found
    return Sequence(folder.absolute(), prefix, digits, suffix, first, first + len(names) - 1)
