"""Frames of a shot: from a video file, a folder of images (also while it is filled) or any iterable of images."""

from __future__ import annotations

import itertools
import logging
import os
import re
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.errors import InputError
from factorsfm.video import decode, has_timestamps, quiet_opencv

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})

_RANGE = re.compile(r"(\d*):(\d*)(?::(\d+))?", re.ASCII)
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])", re.DOTALL)  # neither stuffing nor a restart

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"

_POLL_SECONDS = 0.1  # between two looks at a folder that is being filled
_PATIENCE_SECONDS = 2.0  # an image that has not changed for so long and still cannot be decoded is damaged

# FFmpeg reports broken files on stderr, past all Python logging; a level that the user set is respected.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a shot.

    Attributes:
        index: position in the source, counted from 0 before any range or step is applied.
        image: (h, w, 3) uint8, BGR.
        name: file name, or the zero-padded index for videos and iterables.
        timestamp: seconds from the start of the video, None where unknown.
        dropped: frames of a live source that were skipped right before this one, because nobody was ready for them.
        path: the image file, whose EXIF data may tell the lens; None where there is none.
    """

    index: int
    image: NDArray[np.uint8]
    name: str
    timestamp: float | None = None
    dropped: int = 0
    path: Path | None = None


def parse_range(text: str) -> slice:
    """Parse ``START:STOP[:STEP]``, counted from 0 without STOP; START or STOP may be left out.

    Raises:
        InputError: another form, a negative number, a step of zero, or a range that holds no frame.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None or not any(match.groups()):
        raise InputError(f'frame range "{text}" is not START:STOP[:STEP] with whole numbers from 0')
    start, stop, step = (int(part) if part else None for part in match.groups())
    return checked_range(slice(start, stop, step))


def read_frames(
    source: str | Path | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame], frames: slice | None = None
) -> Iterator[Frame]:
    """Read the frames of a shot one by one, in bounded memory.

    Grey, 16-bit and alpha images become 8-bit BGR; the EXIF orientation is applied.

    Args:
        source: video file, folder of images (in natural order: img2 before img10; other files are ignored),
            or iterable of images, (h, w), (h, w, 3) or (h, w, 4), uint8 or uint16, or of `Frame` objects,
            which keep their index, name and timestamp.
        frames: the part to read, e.g. ``slice(0, 100, 2)``; no negative numbers.

    Raises:
        InputError: at the call, if the source is missing, is no video or holds no images; while iterating,
            if an image is unreadable or truncated, if a frame has another size than the first one, or if
            there is no frame to read.
    """
    selection = checked_range(frames if frames is not None else slice(None))
    if isinstance(source, (str, Path)):
        path = Path(source)
        if path.is_dir():
            images = list_images(path)
            if not images:
                suffixes = ", ".join(sorted(suffix[1:] for suffix in IMAGE_SUFFIXES))
                raise InputError(f"folder {path} holds no images ({suffixes})")
            found = _folder_frames(images, selection)
        elif path.is_file():
            if path.suffix.lower() in IMAGE_SUFFIXES:
                raise InputError(f"{path} is a single image; a video file or a folder of images is expected")
            found = _video_frames(path, selection, timed=has_timestamps(path))
        else:
            raise InputError(f"{path} does not exist; a video file or a folder of images is expected")
        return uniform(found, str(path), selection.start)
    if isinstance(source, np.ndarray) and (source.ndim == 2 or (source.ndim == 3 and source.shape[-1] in (3, 4))):
        raise InputError(f"an array of shape {source.shape} is a single image; a sequence of images is expected")
    if not isinstance(source, Iterable):
        raise InputError(
            f"frames cannot be read from a {type(source).__name__}; "
            "a video file, a folder of images or an iterable of images is expected"
        )
    return uniform(_array_frames(source, selection), "the sequence of images", selection.start)


def checked_range(frames: slice) -> slice:
    """The same range with START and STEP filled in.

    Raises:
        InputError: no slice, a negative number, a step of zero, or a range that holds no frame.
    """
    if not isinstance(frames, slice):
        raise InputError(f"frames is {frames!r}; a slice is expected, such as slice(0, 100, 2)")
    start, stop, step = frames.start or 0, frames.stop, 1 if frames.step is None else frames.step
    text = range_text(frames)
    if start < 0 or (stop is not None and stop < 0) or step < 0:
        raise InputError(f"frame range {text} holds a negative number; frames are counted from 0")
    if step == 0:
        raise InputError(f"frame range {text} has step 0; the step must be at least 1")
    if stop is not None and stop <= start:
        raise InputError(f"frame range {text} is empty; STOP must be larger than START")
    return slice(start, stop, step)


def range_text(frames: slice) -> str:
    """As `parse_range` takes it."""
    start, stop = ("" if part is None else str(part) for part in (frames.start, frames.stop))
    return f"{start}:{stop}" + ("" if frames.step is None else f":{frames.step}")


def uniform(frames: Iterator[Frame], source: str, start: int) -> Iterator[Frame]:
    """Pass the frames on and insist that there is one at least and that all have one size."""
    first: Frame | None = None
    for frame in frames:
        first = first or frame
        (height, width), (first_height, first_width) = frame.image.shape[:2], first.image.shape[:2]
        if (height, width) != (first_height, first_width):
            raise InputError(
                f"frame {frame.index} ({frame.name}) of {source} has {width}x{height} pixels, "
                f"but the first one ({first.name}) has {first_width}x{first_height}"
            )
        yield frame
    if first is None:
        raise InputError(f"{source} holds no frames" + (f" from number {start} on" if start else ""))


def _array_frames(
    images: Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame], selection: slice
) -> Iterator[Frame]:
    chosen = itertools.islice(enumerate(images), selection.start, selection.stop, selection.step)
    for index, image in chosen:
        if isinstance(image, Frame):
            yield replace(image, image=bgr_image(image.image, index))
        else:
            yield Frame(index, bgr_image(image, index), f"{index:06d}")


def bgr_image(image: object, index: int) -> NDArray[np.uint8]:
    """(h, w, 3) uint8 from a grey, BGR or BGRA image of 8 or 16 bits.

    Args:
        index: of the frame, for the message.

    Raises:
        InputError: it is no such image.
    """
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16):
        found = f"an array of {image.dtype}" if isinstance(image, np.ndarray) else f"of type {type(image).__name__}"
        raise InputError(f"frame {index} is {found}; an array of uint8 or uint16 is expected")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or channels not in (1, 3, 4) or image.size == 0:
        raise InputError(f"frame {index} has shape {image.shape}; (h, w), (h, w, 3) or (h, w, 4) is expected")
    depth8 = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if channels == 1:
        return np.repeat(depth8.reshape(*depth8.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(depth8[:, :, :3])


def as_frame(frame: Frame | NDArray[np.uint8], index: int) -> Frame:
    """A frame with a BGR image; an image alone becomes the frame number `index`.

    Raises:
        InputError: it is no image.
    """
    if not isinstance(frame, Frame):
        frame = Frame(index, frame, f"{index:06d}", None)
    return replace(frame, image=bgr_image(frame.image, frame.index))


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


def _folder_frames(paths: list[Path], selection: slice) -> Iterator[Frame]:
    for index in range(len(paths))[selection]:
        yield Frame(index, read_image(paths[index]), paths[index].name, path=paths[index])


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


def _video_frames(path: Path, selection: slice, *, timed: bool) -> Iterator[Frame]:
    for index, image, timestamp in decode(path, selection, timed=timed):
        yield Frame(index, bgr_image(image, index), f"{index:06d}", timestamp)
