"""Image files, and folders of them that are complete or still being filled."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.frames.image_damage import damage_of, without_padding
from factorsfm.frames.plates import PLATE_SUFFIXES, Pixels, plate_pixel_aspect, read_dpx, read_exr
from factorsfm.frames.sequences import sequence_numbers
from factorsfm.frames.silence import held_back, quiet_opencv
from factorsfm.frames.tone import eight_bits
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import is_text

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}) | PLATE_SUFFIXES
_POLL_SECONDS = 0.1  # between two listings of a folder that is being filled
_PATIENCE_SECONDS = 2.0  # a file that has not changed for so long and cannot be decoded is damaged


def list_images(folder: Path) -> list[Path]:
    """Images of a folder in natural order (img2 before img10); an empty list if there are none."""
    return list_files(folder, IMAGE_SUFFIXES)


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these suffixes (lower case) in natural order, without hidden files.

    A symbolic link that leads nowhere counts, so that whoever reads it says so: its frame must not be missed silently.

    Raises:
        InputError: the name of one of them is not text.
    """
    named = (path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith("."))
    found = [path for path in named if path.is_file() or (path.is_symlink() and not path.exists())]
    for path in found:
        if not is_text(path.name):
            raise InputError(f"the file name {path.name!r} in {folder} is not UTF-8; rename the file")
    return sorted(found, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(parts)], path.name


def watch_folder(folder: Path, end_file: str | Path | None, closed: threading.Event) -> Iterator[Frame]:
    """Images of a folder that is still being filled, in natural order, each once it is complete.

    An image that cannot be decoded, or that appears after a later one was taken, is left out with a warning.

    Args:
        end_file: when this file exists (a name in the folder, or a path), the folder is complete.
        closed: set by another thread when no further frames are wanted.
    """
    taken: set[str] = set()
    last: Path | None = None
    arrivals: dict[Path, _Arrival] = {}
    index = -1
    while not closed.is_set():
        complete = end_file is not None and (folder / end_file).exists()  # tested before the folder is listed
        waiting = [path for path in list_images(folder) if path.name not in taken]
        arrivals = {path: _Arrival.seen(path, arrivals.get(path)) for path in waiting}
        for path, arrival in arrivals.items():
            late = last is not None and _natural_key(path) < _natural_key(last)
            image = None if late else arrival.image(path)
            if image is None and not late and not arrival.is_damaged():
                break
            taken.add(path.name)
            if image is None:
                cause = f"it appeared after {last.name}" if late and last is not None else "it is damaged"
                logger.warning("image %s is left out: %s", path, cause)
                continue
            # Alone a name says its number; beside others a stray file might not go on with theirs.
            numbers = sequence_numbers([path.name] if last is None else [last.name, path.name])
            index = index + 1 if numbers is None or numbers[-1] <= index else numbers[-1]
            last = path
            yield Frame(index, image, path.name, path=path, pixel_aspect=stated_pixel_aspect(path))
        else:
            if complete:
                return
        closed.wait(_POLL_SECONDS)


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A file at one listing of the folder.

    Attributes:
        state: its size and time of change; None if it is gone.
        since: monotonic time at which it was first seen in this state, seconds.
        settled: whether it was in this state at the listing before.
    """

    state: tuple[int, int] | None
    since: float
    settled: bool

    @staticmethod
    def seen(path: Path, before: _Arrival | None) -> _Arrival:
        try:
            status = path.stat()
        except OSError:  # renamed or removed after the listing
            state = None
        else:
            state = (status.st_size, status.st_mtime_ns)
        if before is None or before.state != state:
            return _Arrival(state, time.monotonic(), False)
        return _Arrival(state, before.since, True)

    def image(self, path: Path) -> NDArray[np.uint8] | None:
        """The image, None while the file is not complete."""
        if not self.settled:
            return None
        try:
            return read_image(path)
        except InputError:
            return None

    def is_damaged(self) -> bool:
        """Whether a file that cannot be decoded has not changed for so long that nothing more is to come."""
        return time.monotonic() - self.since > _PATIENCE_SECONDS


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image file as (h, w, 3) uint8 BGR, from more bits through `tone.eight_bits`.

    Raises:
        InputError: the file is missing, damaged, truncated or not an image.
    """
    return eight_bits(read_pixels(path))


def read_pixels(path: Path) -> Pixels:
    """An image file as (h, w, 3) BGR with all of its bits: uint8, uint16, or half or float for linear light.

    Raises:
        InputError: the file is missing, damaged, truncated or not an image.
    """
    try:
        if path.suffix.lower() == ".exr":
            path.stat()  # says why a file cannot be read
            return read_exr(path)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror}") from error
    if path.suffix.lower() == ".dpx":
        return read_dpx(data, path)
    # Checked before decoding: libjpeg would fill the rest with grey, libpng would write to stderr, past all logging.
    damage = damage_of(data)
    if damage in ("truncated", "damaged"):
        raise InputError(f"image {path} is {damage}")
    try:
        if damage == "doubtful" and all(map(_libjpeg_complains, (data, without_padding(data)))):
            raise InputError(f"image {path} is damaged")
        image = _decoded(data)
    except cv2.error as error:
        raise InputError(f"image {path} cannot be decoded; it has too many pixels or is damaged") from error
    if image is None:
        raise InputError(f"image {path} cannot be decoded; it is damaged, truncated or not an image")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"image {path} has pixels of {image.dtype}; 8 or 16 bits a channel, or float32, are expected")
    return np.asarray(image)


def _decoded(data: bytes) -> NDArray[np.generic] | None:
    with quiet_opencv():
        color = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
        return cv2.imdecode(np.frombuffer(data, np.uint8), color) if data else None


def _libjpeg_complains(data: bytes) -> bool:
    with held_back() as said:
        _decoded(data)
    return "Corrupt JPEG data" in said.errors


def stated_pixel_aspect(path: Path) -> float:
    """Width of a pixel over its height as an image file says, 1 if it says nothing.

    Raises:
        InputError: a plate is damaged.
    """
    return plate_pixel_aspect(path) if path.suffix.lower() in PLATE_SUFFIXES else 1.0
