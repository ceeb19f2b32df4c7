"""Libraries kept from writing to standard output and error, past all logging, what the caller reports as an error."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
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


_held = threading.Lock()


@dataclass(slots=True)
class Said:
    """What was held back: written to stderr by anybody, and printed by Python."""

    errors: str = ""
    printed: str = ""


@contextmanager
def held_back() -> Iterator[Said]:
    """Hold back what anybody writes to stderr meanwhile, and Python to stdout; it is known after the block.

    For libraries that know no log level. One thread at a time, since all of them share the file descriptor.
    """
    said = Said()
    with _held, tempfile.TemporaryFile() as held:
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            with redirect_stdout(io.StringIO()) as printed:
                yield said
        finally:
            sys.stderr.flush()
            os.dup2(stderr, 2)
            os.close(stderr)
            held.seek(0)
            said.errors, said.printed = held.read().decode(errors="replace"), printed.getvalue()


@contextmanager
def opencv_errors() -> Iterator[Said]:
    """Hold back the errors that OpenCV logs meanwhile, and whatever else is written; see `held_back`."""
    with held_back() as said, _silence.lock:  # the level is that of all threads
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        try:
            yield said
        finally:
            cv2.utils.logging.setLogLevel(level)


@contextmanager
def dropped_if_it_fails() -> Iterator[None]:
    """Drop what is written meanwhile if the block raises an exception, else pass it on; see `held_back`."""
    with held_back() as said:
        yield
    sys.stderr.write(said.errors)
    print(said.printed, end="")
