"""Sources of frames, read beside their consumer: files, folders that fill, cameras, networks, pipes, iterables."""

from __future__ import annotations

import io
import itertools
import logging
import re
import select
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeGuard, cast
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.folders import list_images, watch_folder
from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.reading import read_frames, uniform
from factorsfm.frames.unordered import Unusable, read_images
from factorsfm.frames.video import quiet_opencv
from factorsfm.support.context import Closing
from factorsfm.support.errors import FactorsfmError, InputError

logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.1  # between two looks whether anybody still wants what a pipe gives
_JOIN_SECONDS = 1.0

_BYTES_PER_PIXEL = {"bgr24": 3.0, "rgb24": 3.0, "gray8": 1.0, "yuv420p": 1.5, "nv12": 1.5}
_YUV = {"yuv420p": cv2.COLOR_YUV2BGR_I420, "nv12": cv2.COLOR_YUV2BGR_NV12}


@dataclass(frozen=True, slots=True)
class RawFormat:
    """Frames without any container, one after another.

    Attributes:
        width, height: pixels; even for yuv420p and nv12.
        pixels: bgr24, rgb24, gray8, yuv420p (also known as I420) or nv12, as FFmpeg names them.

    Raises:
        InputError: there is no such format.
    """

    width: int
    height: int
    pixels: str = "bgr24"

    def __post_init__(self) -> None:
        if self.pixels not in _BYTES_PER_PIXEL:
            raise InputError(f'pixel format "{self.pixels}" is not one of {", ".join(_BYTES_PER_PIXEL)}')
        if self.width < 1 or self.height < 1:
            raise InputError(f"raw frames of {self.width}x{self.height} pixels hold nothing")
        if self.pixels in _YUV and (self.width % 2 or self.height % 2):
            raise InputError(f"raw frames of {self.width}x{self.height} pixels: {self.pixels} needs even numbers")

    @classmethod
    def parse(cls, text: str) -> RawFormat:
        """From ``WIDTHxHEIGHT:PIXELS``, e.g. ``960x540:yuv420p``."""
        match = re.fullmatch(r"(\d+)x(\d+):(\w+)", text.strip(), re.ASCII)
        if match is None:
            raise InputError(f'raw format "{text}" is not WIDTHxHEIGHT:PIXELS, for example 960x540:bgr24')
        return cls(int(match[1]), int(match[2]), match[3])

    @property
    def frame_bytes(self) -> int:
        """Size of one frame, bytes."""
        return int(self.width * self.height * _BYTES_PER_PIXEL[self.pixels])

    def image(self, data: bytes | bytearray) -> NDArray[np.uint8]:
        """(height, width, 3) BGR from the bytes of one frame."""
        values = np.frombuffer(data, np.uint8)
        if self.pixels in _YUV:
            planes = values.reshape(self.height * 3 // 2, self.width)
            return np.asarray(cv2.cvtColor(planes, _YUV[self.pixels]), np.uint8)
        image = values.reshape(self.height, self.width, -1)
        return bgr_image(image[:, :, ::-1] if self.pixels == "rgb24" else image, 0)


def open_source(
    source: str | Path | int | BinaryIO | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame],
    *,
    frames: slice | None = None,
    raw: RawFormat | None = None,
    watch: bool = False,
    end_file: str | Path | None = None,
    drop: bool | None = None,
    queue_size: int = 4,
    stall_seconds: float | None = 10.0,
) -> Source:
    """Open a source and begin to read it beside the consumer.

    Args:
        source: a video file, a folder of images or an iterable, as in `read_frames`, but damaged images of a folder
            are left out; a camera (its number, or "camera:0"); the URL of a network stream (anything with "://"); "-"
            for standard input, or a binary file object, of raw frames.
        frames: the part to read; the indices of the frames count in the source.
        raw: size and pixel format of raw frames.
        watch: wait for further images in a folder. They are taken in natural order, each once it is complete; one that
            appears after a later one was taken is left out.
        end_file: with `watch`: the folder is complete when this file exists (a name in the folder, or a path).
        drop: where the consumer is slower, True drops the frames that have waited longest, False waits; None drops
            for cameras and network streams only.
        queue_size: frames that may wait for the consumer.
        stall_seconds: a source without a new frame for so long has ended; None waits for ever.

    Raises:
        InputError: the source is missing, cannot be opened, or an argument contradicts it.
    """
    if queue_size < 1 or (stall_seconds is not None and stall_seconds <= 0):
        raise InputError(f"queue_size is {queue_size} and stall_seconds {stall_seconds}; positive numbers are expected")
    if raw is not None and not _is_raw(source):
        raise InputError(f"a raw format was given, but {source} is no stream of raw frames")
    if end_file is not None and not watch:
        raise InputError(f"end file {end_file} has no meaning unless a folder is watched")
    closed = threading.Event()
    live = False
    if watch:
        if not isinstance(source, str | Path) or not Path(source).is_dir():
            raise InputError(f"{source} cannot be watched; a folder that exists is expected")
        name, found = f"folder {source}", watch_folder(Path(source), end_file, closed)
    elif (camera := _camera_number(source)) is not None:
        name, live = f"camera {camera}", True
        found = _captured(_open_device(name, camera), name, closed)
    elif isinstance(source, str) and "://" in source:
        name, live = _without_secrets(source), True
        found = _captured(_open_device(name, source, cv2.CAP_FFMPEG, _timeouts(stall_seconds)), name, closed)
    elif _is_raw(source):
        name = "standard input" if source == "-" else "the raw stream"
        if raw is None:
            raise InputError(f"{name} holds raw frames; their size and pixel format must be given")
        if isinstance(source, io.TextIOBase):
            raise InputError(f"{name} was opened as text; a binary file is expected")
        found = _raw_frames(sys.stdin.buffer if source == "-" else source, raw, name, closed)
    elif isinstance(source, str | Path) and Path(source).is_dir() and list_images(Path(source)):
        name, part = str(source), checked_range(frames if frames is not None else slice(None))
        found, frames = uniform(_readable(read_images(source, part)), name, part.start), None  # it skips, too
    else:
        name = str(source) if isinstance(source, str | Path) else "the sequence of images"
        files = cast("str | Path | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame]", source)
        found, frames = read_frames(files, frames), None  # it skips without decoding
    selection = checked_range(frames if frames is not None else slice(None))
    chosen = uniform(_chosen(found, selection), name, selection.start)
    return Source(chosen, name, closed, live if drop is None else drop, queue_size, stall_seconds)


def _readable(images: Iterator[Frame | Unusable]) -> Iterator[Frame]:
    """The images of a folder without those that are damaged, which must not end the shot."""
    for image in images:
        if isinstance(image, Frame):
            yield image
        else:
            logger.warning("image %s is left out: %s", image.name, image.reason)


class Source(Closing, Iterator[Frame]):
    """Frames of a source, read by a thread of its own while they are consumed; made by `open_source`.

    Iterate over it, best in a ``with`` statement; leaving it, `close` or the end of the last reference stop the thread
    and release the device. However the source ends after its first frame, the iteration just stops.

    Attributes:
        name: of the source, for messages; no passwords of a URL.
        ended: one sentence on why there are no further frames; empty while there may be.
        broke_off: whether that was no regular end: it stalled, broke off inside a frame, or was damaged.
        delivered: frames so far.

    Raises:
        InputError: while iterating, if there is not even a first frame.
    """

    def __init__(
        self,
        frames: Iterator[Frame],
        name: str,
        closed: threading.Event,
        drop: bool,
        queue_size: int,
        stall_seconds: float | None,
    ) -> None:
        self.name = name
        self.ended = ""
        self.broke_off = False
        self.delivered = 0
        self._stall_seconds = stall_seconds
        self._queue = _Queue(queue_size, drop, closed)
        # The thread must not know this object, which is to be collected when nobody consumes any more.
        self._thread = threading.Thread(target=self._queue.fill, args=(frames,), name=f"read {name}", daemon=True)
        self._stop = weakref.finalize(self, self._queue.close)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames dropped so far."""
        return self._queue.dropped

    def __next__(self) -> Frame:
        if self.ended:
            raise StopIteration
        frame = self._queue.take(self._stall_seconds)
        if frame is not None:
            self.delivered += 1
            return frame
        if self.ended:  # closed by another thread while this one waited
            raise StopIteration
        error = self._queue.error
        if not self._queue.finished:
            error = InputError(f"{self.name} gave no frame for {self._stall_seconds:g} s")
        self._end(error)
        raise StopIteration

    def close(self) -> None:
        """Stop reading and release the device; frames that still wait are gone."""
        self.ended = self.ended or f"{self.name} was closed after {self._count()}"
        self._stop()
        self._thread.join(_JOIN_SECONDS)  # unless it is stuck in foreign code, which nobody can interrupt

    def _end(self, error: Exception | None) -> None:
        self.ended = f"{self.name} ended after {self._count()}"
        if error is not None:
            self.broke_off = True
            reason = str(error) if isinstance(error, FactorsfmError) else f"{self.name} failed: {error!r}"
            self.ended = f"broken off after {self._count()}: {reason}"
        self.close()
        if error is not None and self.delivered == 0:
            raise error if isinstance(error, FactorsfmError) else InputError(reason) from error
        if error is not None:
            logger.warning(self.ended)

    def _count(self) -> str:
        dropped = f", {self.dropped} of them dropped" if self.dropped else ""
        return f"{self.delivered + self.dropped} frames{dropped}"


class _Queue:
    """Frames between the thread that reads and the one that consumes."""

    def __init__(self, size: int, drop: bool, closed: threading.Event) -> None:
        self.finished = False
        self.error: Exception | None = None
        self.dropped = 0
        self._size = size
        self._drop = drop
        self._closed = closed
        self._waiting: deque[Frame] = deque()
        self._dropped_before = 0  # since a frame was taken, so all of them right before the next one
        self._changed = threading.Condition()

    def fill(self, frames: Iterator[Frame]) -> None:
        """Read until the end; the thread."""
        try:
            for frame in frames:
                if not self._put(frame):
                    break
        except Exception as error:  # whatever ends a source must not end what was made of it
            self.error = error
        finally:
            with self._changed:
                self.finished = True
                self._changed.notify_all()

    def _put(self, frame: Frame) -> bool:
        with self._changed:
            if self._drop and len(self._waiting) == self._size:
                self._waiting.popleft()
                self._dropped_before += 1
                self.dropped += 1
            self._changed.wait_for(lambda: len(self._waiting) < self._size or self._closed.is_set())
            self._waiting.append(frame)
            self._changed.notify_all()
        return not self._closed.is_set()

    def take(self, timeout: float | None) -> Frame | None:
        """The next frame; None after the end, and where none came within the timeout (seconds)."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.finished, timeout)
            if not self._waiting:
                return None
            frame = self._waiting.popleft()
            if self._dropped_before:
                frame, self._dropped_before = replace(frame, dropped=self._dropped_before), 0
            self._changed.notify_all()
            return frame

    def close(self) -> None:
        with self._changed:
            self._closed.set()
            self._changed.notify_all()


def _chosen(frames: Iterator[Frame], selection: slice) -> Iterator[Frame]:
    """As `itertools.islice`, which would read on to the next step before it stops."""
    for position in itertools.count():
        frame = next(frames, None) if selection.stop is None or position < selection.stop else None
        if frame is None:
            return
        if position >= selection.start and (position - selection.start) % selection.step == 0:
            yield frame


def _camera_number(source: object) -> int | None:
    if isinstance(source, int) and not isinstance(source, bool):
        if source < 0:
            raise InputError(f"{source} is no camera; they are counted from 0")
        return source
    match = re.fullmatch(r"camera:(.*)", source) if isinstance(source, str) else None
    if match is not None and not re.fullmatch(r"\d+", match[1], re.ASCII):
        raise InputError(f'"{source}" names no camera; camera:0 is the first one')
    return None if match is None else int(match[1])


def _is_raw(source: object) -> TypeGuard[BinaryIO | Literal["-"]]:
    return source == "-" if isinstance(source, str) else hasattr(source, "read")


def _without_secrets(url: str) -> str:
    """Without user, password and query."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


def _timeouts(stall_seconds: float | None) -> list[int]:
    if stall_seconds is None:
        return []
    limit = max(1, round(1000 * stall_seconds))
    return [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]


def _open_device(name: str, *arguments: Any) -> cv2.VideoCapture:
    with quiet_opencv():
        capture = cv2.VideoCapture(*arguments)
    if not capture.isOpened():
        capture.release()
        raise InputError(f"{name} cannot be opened")
    return capture


def _captured(capture: cv2.VideoCapture, name: str, closed: threading.Event) -> Iterator[Frame]:
    """Frames of a camera or network stream, by the time of their arrival; these have no regular end."""
    try:
        begin: float | None = None
        for index in itertools.count():
            decoded, image = capture.read()
            if closed.is_set():
                return
            if not decoded:
                raise InputError(f"{name} gives no further frame")
            now = time.monotonic()
            begin = now if begin is None else begin
            yield Frame(index, bgr_image(image, index), f"{index:06d}", now - begin)
    finally:
        capture.release()


def _raw_frames(file: BinaryIO, raw: RawFormat, name: str, closed: threading.Event) -> Iterator[Frame]:
    for index in itertools.count():
        data = _read(file, raw.frame_bytes, closed)
        if not data or closed.is_set():
            return
        if len(data) < raw.frame_bytes:
            raise InputError(f"{name} ended inside frame {index}: {len(data)} of {raw.frame_bytes} bytes")
        yield Frame(index, raw.image(data), f"{index:06d}")


def _read(file: BinaryIO, size: int, closed: threading.Event) -> bytearray:
    """As many bytes, fewer at the end of the file; looks up now and then whether anybody still wants them."""
    read_some = getattr(file, "read1", file.read)  # what a pipe holds now, without waiting for the rest
    data = bytearray()
    while len(data) < size and not closed.is_set():
        if _is_readable(file):
            part = read_some(size - len(data))
            if not part:
                break
            data += part
    return data


def _is_readable(file: BinaryIO) -> bool:
    try:
        return bool(select.select([file], [], [], _POLL_SECONDS)[0])
    except (OSError, ValueError, TypeError):  # no descriptor, or none that can be waited for: reading may block
        return True
