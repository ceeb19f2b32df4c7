"""Image files and the folders that hold them, complete or still being filled."""

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
from factorsfm.frames.video import quiet_opencv
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)  # neither stuffing nor a restart
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_POLL_SECONDS = 0.1  # between two looks at a folder that is being filled
_PATIENCE_SECONDS = 2.0  # an image that has not changed for so long and still cannot be decoded is damaged


def list_images(folder: Path) -> list[Path]:
    """Images of a folder in natural order, img2 before img10; none is no error."""
    return list_files(folder, IMAGE_SUFFIXES)


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these suffixes (lower case) in natural order; none is no error."""
    found = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    ]
    return sorted(found, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(parts)], path.name


def watch_folder(folder: Path, end_file: str | Path | None, closed: threading.Event) -> Iterator[Frame]:
    """Images of a folder that is still being filled, each once it is complete.

    Args:
        end_file: when it exists (a name in the folder, or a path) nothing further comes.
        closed: set by another thread when nobody wants further frames.
    """
    taken: set[str] = set()
    last: Path | None = None
    arrivals: dict[Path, _Arrival] = {}
    index = 0
    while not closed.is_set():
        complete = end_file is not None and (folder / end_file).exists()  # before the look: nothing comes after it
        waiting = [path for path in list_images(folder) if path.name not in taken]
        arrivals = {path: _Arrival.seen(path, arrivals.get(path)) for path in waiting}
        for path, arrival in arrivals.items():
            late = last is not None and _natural_key(path) < _natural_key(last)
            image = None if late else arrival.image(path)
            if image is None and not late and not arrival.given_up():
                break
            taken.add(path.name)
            if image is None:
                cause = f"it appeared after {last.name}" if late and last is not None else "it is damaged"
                logger.warning("image %s is left out: %s", path, cause)
                continue
            last = path
            yield Frame(index, image, path.name, path=path)
            index += 1
        else:
            if complete:
                return
        closed.wait(_POLL_SECONDS)


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A file as it was at a look at the folder; `since` is when it was first seen like this."""

    state: tuple[int, int] | None
    since: float
    settled: bool

    @staticmethod
    def seen(path: Path, before: _Arrival | None) -> _Arrival:
        try:
            status = path.stat()
        except OSError:  # renamed or removed since the look
            return _Arrival(None, time.monotonic(), False)
        state = (status.st_size, status.st_mtime_ns)
        if before is None or before.state != state:
            return _Arrival(state, time.monotonic(), False)
        return _Arrival(state, before.since, True)

    def image(self, path: Path) -> NDArray[np.uint8] | None:
        """None as long as the file is not complete."""
        if not self.settled:
            return None
        try:
            return read_image(path)
        except InputError:
            return None

    def given_up(self) -> bool:
        return time.monotonic() - self.since > _PATIENCE_SECONDS


def read_image(path: Path) -> NDArray[np.uint8]:
    """(h, w, 3) BGR.

    Raises:
        InputError: the file is missing, damaged, truncated or no image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror}") from error
    # Both before decoding: libjpeg fills the rest with grey, and libpng complains on stderr, past all logging.
    if (data.startswith(b"\xff\xd8") and _jpeg_is_truncated(data)) or (data.startswith(_PNG) and _PNG_END not in data):
        raise InputError(f"image {path} is truncated")
    with quiet_opencv():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        other = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data and image is None else None
    if other is not None:
        raise InputError(f"image {path} has pixels of {other.dtype}; 8 or 16 bits a channel are expected")
    if image is None:
        raise InputError(f"image {path} cannot be decoded; it is damaged, truncated or not an image")
    return np.asarray(image, dtype=np.uint8)


def _jpeg_is_truncated(data: bytes) -> bool:
    """Whether the end marker is missing."""
    position = 2
    while marker := _JPEG_MARKER.search(data, position):
        if marker[1] == b"\xd9":
            return False
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return True
