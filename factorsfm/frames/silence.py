"""OpenCV kept from writing to standard error."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import cv2


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
