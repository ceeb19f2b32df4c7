"""Sources of frames that are read in a thread of their own, beside the consumer.

A source is a video file, a folder of images (also one that is still being filled), a camera, a network stream, a pipe
of raw frames, or an iterable of images.
"""

from __future__ import annotations

import io
import itertools
import logging
import sys
import threading
import weakref
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Literal, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.capture import (
    camera_number,
    captured_frames,
    open_camera_device,
    open_network_stream,
    without_secrets,
)
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_images, unread_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.raw import RawFormat, raw_frames
from factorsfm.frames.reading import check_footage, read_frames, uniform, with_aspect
from factorsfm.frames.unordered import Unusable, read_images
from factorsfm.frames.watched_folder import watch_folder
from factorsfm.support.context import Closing
from factorsfm.support.errors import FactorsfmError, InputError
from factorsfm.support.first_few import first_few

logger = logging.getLogger(__name__)

_JOIN_SECONDS = 1.0  # how long `Source.close` waits for the reading thread


def open_source(
    source: str | Path | int | BinaryIO | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame],
    *,
    frames: slice | None = None,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
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
            are left out; a camera (its number, or "camera:0"); the URL of a network stream (anything with "://"); raw
            frames from standard input ("-") or a binary file object.
        frames: the range to read; frames keep their index in the source.
        fields, pixel_aspect: of a video file, as in `read_frames`; the pixel aspect of other sources, too.
        raw: size and pixel format of raw frames.
        watch: whether to wait for further images in a folder. They are taken in natural order, each once it is
            complete; one that appears after a later one was taken, or belongs to another sequence, is left out.
        end_file: with `watch`, the folder is complete when this file exists (a name in the folder, or a path).
        drop: what happens when the consumer is too slow. True drops the frames that have waited longest, False makes
            the source wait, None drops for cameras and network streams only.
        queue_size: most frames that wait for the consumer.
        stall_seconds: a source that gives no new frame for this long has ended; None waits for ever.

    Raises:
        InputError: the source does not exist or cannot be opened, or an argument contradicts it.
    """
    if queue_size < 1 or (stall_seconds is not None and stall_seconds <= 0):
        raise InputError(f"queue_size is {queue_size} and stall_seconds {stall_seconds}; positive numbers are expected")
    if raw is not None and not _is_raw(source):
        raise InputError(f"a raw format was given, but {source} is no stream of raw frames")
    if end_file is not None and not watch:
        raise InputError(f"end file {end_file} has no meaning unless a folder is watched")
    check_footage(fields, pixel_aspect)
    closed = threading.Event()
    selection = checked_range(frames if frames is not None else slice(None))
    if watch:
        opened = _watch(source, end_file, closed)
    elif _is_raw(source):
        opened = _open_raw(source, raw, closed)
    else:
        opened = _open_device(source, stall_seconds, closed) or _open_files(source, selection, fields)
    chosen = opened.frames if opened.is_selected else _selected(opened.frames, selection)
    same_size = uniform(with_aspect(chosen, pixel_aspect), opened.name, selection.start)
    return Source(same_size, opened.name, closed, opened.is_live if drop is None else drop, queue_size, stall_seconds)


@dataclass(frozen=True, slots=True)
class _Opened:
    """An open source.

    Attributes:
        name: for messages, without passwords.
        frames: its frames, all of them or those of the range.
        is_live: whether frames are lost if nobody takes them in time.
        is_selected: whether `frames` are those of the range; files skip the others without decoding them.
    """

    name: str
    frames: Iterator[Frame]
    is_live: bool = False
    is_selected: bool = False


def _watch(source: object, end_file: str | Path | None, closed: threading.Event) -> _Opened:
    if not isinstance(source, str | Path) or not Path(source).is_dir():
        raise InputError(f"{source} cannot be watched; a folder that exists is expected")
    return _Opened(f"folder {source}", watch_folder(Path(source), end_file, closed))


def _open_device(source: object, stall_seconds: float | None, closed: threading.Event) -> _Opened | None:
    """A camera or network stream; None if the source names neither."""
    if (number := camera_number(source)) is not None:
        name = f"camera {number}"
        capture = open_camera_device(number, name)
    elif isinstance(source, str) and "://" in source:
        name = without_secrets(source)
        capture = open_network_stream(source, name, stall_seconds)
    else:
        return None
    return _Opened(name, captured_frames(capture, name, closed), is_live=True)


def _open_raw(source: BinaryIO | Literal["-"], raw: RawFormat | None, closed: threading.Event) -> _Opened:
    name = "standard input" if source == "-" else "the raw stream"
    if raw is None:
        raise InputError(f"{name} holds raw frames; their size and pixel format must be given")
    if isinstance(source, io.TextIOBase):
        raise InputError(f"{name} was opened as text; a binary file is expected")
    return _Opened(name, raw_frames(sys.stdin.buffer if source == "-" else source, raw, name, closed))


def _open_files(source: object, selection: slice, fields: Fields) -> _Opened:
    """A folder of images, a video file or an iterable of images."""
    if isinstance(source, str | Path) and Path(source).is_dir() and list_images(Path(source)):
        if unread := unread_images(Path(source)):
            logger.warning("images in formats that are not read are left out: %s", first_few(unread, 5))
        return _Opened(str(source), _readable(read_images(source, selection, numbered=True)), is_selected=True)
    name = str(source) if isinstance(source, str | Path) else "the sequence of images"
    files = cast("str | Path | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame]", source)
    return _Opened(name, read_frames(files, selection, fields=fields), is_selected=True)


def _is_raw(source: object) -> TypeGuard[BinaryIO | Literal["-"]]:
    return source == "-" if isinstance(source, str) else hasattr(source, "read")


def _readable(images: Iterator[Frame | Unusable]) -> Iterator[Frame]:
    """The images of a folder without the damaged ones, which must not end the shot."""
    for image in images:
        if isinstance(image, Frame):
            yield image
        else:
            logger.warning("image %s is left out: %s", image.name, image.reason)


def _selected(frames: Iterator[Frame], selection: slice) -> Iterator[Frame]:
    """As `itertools.islice`, which would read one step beyond the end before it stops."""
    for position in itertools.count():
        frame = next(frames, None) if selection.stop is None or position < selection.stop else None
        if frame is None:
            return
        if position >= selection.start and (position - selection.start) % selection.step == 0:
            yield frame


class Source(Closing, Iterator[Frame]):
    """Frames of a source, read in a thread of its own while they are consumed; `open_source` makes it.

    Iterate over it, best in a ``with`` statement. The end of the statement, `close`, or the end of the last reference
    stops the thread and releases the device. Once there was a first frame, any end of the source just ends the
    iteration.

    Attributes:
        name: name of the source for messages; a URL is without its password.
        ended: one sentence on why there are no further frames; empty while there may be some.
        broke_off: whether the source ended irregularly: it stalled, ended inside a frame, or is damaged.
        delivered: number of frames so far.

    Raises:
        InputError: while iterating, if there is no first frame.
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
        # The thread holds no reference to this object, so that it is collected when the consumer drops it.
        self._thread = threading.Thread(target=self._queue.fill, args=(frames,), name=f"read {name}", daemon=True)
        self._stop = weakref.finalize(self, self._queue.close)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of frames dropped so far."""
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
        """Stop reading and release the device; frames that still wait are dropped."""
        self.ended = self.ended or f"{self.name} was closed after {self._count()}"
        self._stop()
        self._thread.join(_JOIN_SECONDS)  # it may hang in a read of OpenCV, which cannot be interrupted

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
    """The frames that wait between the thread that reads and the one that consumes.

    Attributes:
        finished: whether the source has ended.
        error: what ended it, None at a regular end.
        dropped: number of frames dropped so far.
    """

    def __init__(self, size: int, drop: bool, closed: threading.Event) -> None:
        self.finished = False
        self.error: Exception | None = None
        self.dropped = 0
        self._size = size
        self._drop = drop
        self._closed = closed
        self._waiting: deque[Frame] = deque()
        self._dropped_before = 0  # dropped since the last frame was taken, so right before the next one
        self._changed = threading.Condition()

    def fill(self, frames: Iterator[Frame]) -> None:
        """Read until the end of the source; runs in the reading thread."""
        try:
            for frame in frames:
                if not self._put(frame):
                    break
        except Exception as error:  # the consumer decides what a failure means
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
        """The next frame; None at the end of the source, or if none comes within `timeout` seconds."""
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
