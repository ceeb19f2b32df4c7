"""Video files: decoded in order, from the start or from a later frame that its timestamp identifies."""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (
    *(".avi", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg"),
    *(".mpg", ".mts", ".mxf", ".ogv", ".ts", ".webm", ".wmv"),
)
_SEEK_FROM = 100  # frames: decoding fewer is faster than reading the packets of the whole file
_COMPARED = 16  # frames at the start of the file whose timestamps must be those of its packets
_SAME_MS = 1e-3  # largest difference of two equal timestamps
_ANNOUNCED_SHARE = 0.95  # of the frames that the container announces, which is not exact


def has_timestamps(path: Path) -> bool:
    """Whether the container has timestamps; without them OpenCV reports 0 for every frame.

    Raises:
        InputError: the file is not a video.
    """
    with _open(path) as video:
        if not video.grab():
            raise InputError(f"{path} cannot be decoded as a video; {_problem(video)}")
        return bool(video.grab() and video.get(cv2.CAP_PROP_POS_MSEC) > 0)


def decode(path: Path, selection: slice, *, timed: bool) -> Iterator[tuple[int, NDArray[np.uint8], float | None]]:
    """Index, image and timestamp (seconds) of the frames of a range.

    Args:
        selection: the range, see `checked_range`.
        timed: whether the container has timestamps, see `has_timestamps`.

    Raises:
        InputError: a frame cannot be decoded.
    """
    last = selection.stop - 1 if selection.stop is not None else None
    with _open(path) as video:
        grabbed = False  # whether the next frame is grabbed already
        if timed and selection.start >= _SEEK_FROM:
            grabbed = _seek(video, path, selection.start)
            if not grabbed:
                video.open(str(path))
        for index in itertools.count(selection.start if grabbed else 0):
            if last is not None and index > last:
                return
            if not (grabbed or video.grab()):
                _warn_if_short(index, video.get(cv2.CAP_PROP_FRAME_COUNT), path)
                return
            grabbed = False
            if index < selection.start or (index - selection.start) % selection.step:
                continue
            timestamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000 if timed else None
            decoded, image = video.retrieve()
            if not decoded:
                raise InputError(f"frame {index} of {path} cannot be decoded")
            yield index, np.asarray(image, np.uint8), timestamp


def _problem(video: cv2.VideoCapture) -> str:
    """What is wrong with a file that gives no frame."""
    if not video.isOpened():
        return "it is damaged or not a video"
    codec = (int(video.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").decode("ascii", "replace").strip()
    return f"it is damaged, or this build of OpenCV lacks its codec ({codec}); convert it to H.264"


def _warn_if_short(frames: int, announced: float, path: Path) -> None:
    """Log a warning if a file has clearly fewer frames than its container announces."""
    if frames < _ANNOUNCED_SHARE * announced - 1.0:
        logger.warning(
            "%s: only %d of the %.0f frames that the container announces can be read; the others are damaged, missing, "
            "or hidden by an edit",
            path, frames, announced,
        )  # fmt: skip


def _seek(video: cv2.VideoCapture, path: Path, index: int) -> bool:
    """Seek a frame and grab it; False if the frame that is reached may be another one.

    Neither the frame count nor seeking of OpenCV can be trusted. But the packets of the file hold the timestamps of all
    frames, which are read without decoding, and the timestamp of the frame that is reached identifies it.
    """
    status = path.stat()
    times = _frame_times(path, status.st_size, status.st_mtime_ns)
    if index >= len(times):
        return False
    video.set(cv2.CAP_PROP_POS_FRAMES, index)
    while video.grab():
        late_ms = video.get(cv2.CAP_PROP_POS_MSEC) - times[index]
        if late_ms > -_SAME_MS:
            return bool(late_ms < _SAME_MS)
    return False


@lru_cache(8)
def _frame_times(path: Path, size: int, modified_ns: int) -> NDArray[np.float64]:
    """Timestamps (ms) of all frames of a file, ascending, from its packets; empty if they do not identify the frames.

    They do not if two are equal, or if an edit list hides packets, so that the first decoded frames have other
    timestamps.

    Args:
        size, modified_ns: of the file now; a file that changes is read again.
    """
    packets = []
    with _open(path) as video:
        if video.set(cv2.CAP_PROP_FORMAT, -1):  # packets, not decoded
            while video.grab():
                packets.append(video.get(cv2.CAP_PROP_POS_MSEC))
    with _open(path) as video:
        first = [video.get(cv2.CAP_PROP_POS_MSEC) for _ in range(_COMPARED) if video.grab()]
    times = np.sort(np.array(packets, np.float64))
    agree = len(times) >= len(first) and (np.abs(np.array(first) - times[: len(first)]) < _SAME_MS).all()
    return times if agree and (np.diff(times) > _SAME_MS).all() else times[:0]


@contextmanager
def _open(path: Path) -> Iterator[cv2.VideoCapture]:
    with quiet_opencv():
        video = cv2.VideoCapture(str(path))
    try:
        yield video
    finally:
        video.release()


@dataclass(slots=True)
class _Silence:
    """OpenCV's log level, which all threads share: the first one to enter saves it, the last one to leave restores it.

    Attributes:
        users: threads that keep OpenCV silent now.
        level: the log level before.
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    users: int = 0
    level: int = 0


_silence = _Silence()


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing to stderr; the caller reports the failure as an `InputError`."""
    with _silence.lock:
        if _silence.users == 0:
            _silence.level = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _silence.users += 1
    try:
        yield
    finally:
        with _silence.lock:
            _silence.users -= 1
            if _silence.users == 0:
                cv2.utils.logging.setLogLevel(_silence.level)
