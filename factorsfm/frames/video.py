"""Video files: decoded in order, or from a later frame on that its time tells from all others."""

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

_SEEK_FROM = 100  # frames, that are decoded sooner than the file is looked through
_COMPARED = 16  # frames at the start of the file whose times must be those of its packets
_SAME_MS = 1e-3


def has_timestamps(path: Path) -> bool:
    """Whether the container has timestamps (without them every frame is said to be at 0).

    Raises:
        InputError: the file is no video.
    """
    with _open(path) as video:
        if not video.grab():
            raise InputError(f"{path} cannot be decoded as a video; {_why_not(video)}")
        return bool(video.grab() and video.get(cv2.CAP_PROP_POS_MSEC) > 0)


def decode(path: Path, selection: slice, *, timed: bool) -> Iterator[tuple[int, NDArray[np.uint8], float | None]]:
    """Index, image and timestamp (seconds) of the frames of a range whose START and STEP are given.

    Args:
        timed: whether the container has timestamps.

    Raises:
        InputError: a frame cannot be decoded.
    """
    last = selection.stop - 1 if selection.stop is not None else None
    with _open(path) as video:
        ready = False
        if timed and selection.start >= _SEEK_FROM:
            ready = _found(video, path, selection.start)
            if not ready:
                video.open(str(path))
        for index in itertools.count(selection.start if ready else 0):
            if last is not None and index > last:
                return
            if not (ready or video.grab()):
                _compare(index, video.get(cv2.CAP_PROP_FRAME_COUNT), path)
                return
            ready = False
            if index < selection.start or (index - selection.start) % selection.step:
                continue
            timestamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000 if timed else None
            decoded, image = video.retrieve()
            if not decoded:
                raise InputError(f"frame {index} of {path} cannot be decoded")
            yield index, np.asarray(image, np.uint8), timestamp


def _why_not(video: cv2.VideoCapture) -> str:
    """What is wrong with a file that yields no frame."""
    if not video.isOpened():
        return "it is damaged or not a video"
    codec = (int(video.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").decode("ascii", "replace").strip()
    return f"it is damaged, or this build of OpenCV lacks its codec ({codec}); convert it to H.264"


def _compare(frames: int, announced: float, path: Path) -> None:
    """Say so where a file ends well before what its container announces, which is not exact."""
    if frames < 0.95 * announced - 1.0:
        logger.warning(
            "%s: only %d of the %.0f frames that the container announces can be read; the others are damaged, missing, "
            "or hidden by an edit",
            path, frames, announced,
        )  # fmt: skip


def _found(video: cv2.VideoCapture, path: Path, index: int) -> bool:
    """Seek a frame and grab it; whether that worked, and it is the frame with this number without doubt.

    Neither the number of frames nor seeking can be trusted in general. But the packets of the file tell the times of
    all frames without decoding any, and the time of the frame that was reached tells which one it is.
    """
    status = path.stat()
    times = _times(path, status.st_size, status.st_mtime_ns)
    if index >= len(times):
        return False
    video.set(cv2.CAP_PROP_POS_FRAMES, index)
    while video.grab():
        late = video.get(cv2.CAP_PROP_POS_MSEC) - times[index]
        if late > -_SAME_MS:
            return bool(late < _SAME_MS)
    return False


@lru_cache(8)
def _times(path: Path, size: int, modified_ns: int) -> NDArray[np.float64]:
    """Times (ms) of all frames of a file as it is now, ascending, from its packets; none where these leave a doubt.

    Two at one time would, and so would packets that are hidden or cut off by an edit: then the first frames that are
    decoded have other times.
    """
    packets = []
    with _open(path) as video:
        if video.set(cv2.CAP_PROP_FORMAT, -1):  # packets as they are
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
    """The log level of OpenCV belongs to the process: the first thread in saves it, the last one out restores it."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    wanted: int = 0
    level: int = 0


_silence = _Silence()


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing to stderr what is reported as an InputError."""
    with _silence.lock:
        if _silence.wanted == 0:
            _silence.level = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _silence.wanted += 1
    try:
        yield
    finally:
        with _silence.lock:
            _silence.wanted -= 1
            if _silence.wanted == 0:
                cv2.utils.logging.setLogLevel(_silence.level)
