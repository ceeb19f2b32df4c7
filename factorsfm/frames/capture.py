"""Cameras and network streams, through OpenCV."""

from __future__ import annotations

import itertools
import os
import re
import threading
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import cv2

from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.frames.silence import quiet_opencv
from factorsfm.support.errors import InputError

# OpenCV's FFmpeg reports broken streams on stderr, past all Python logging. A level that the user has set stays.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def camera_number(source: object) -> int | None:
    """The number of the camera that a source names (2 or "camera:2"); None if it names none.

    Raises:
        InputError: a negative number, or "camera:" followed by something else.
    """
    if isinstance(source, int) and not isinstance(source, bool):
        if source < 0:
            raise InputError(f"{source} is no camera; they are counted from 0")
        return source
    match = re.fullmatch(r"camera:(.*)", source) if isinstance(source, str) else None
    if match is not None and not re.fullmatch(r"\d{1,9}", match[1], re.ASCII):
        raise InputError(f'"{source}" names no camera; camera:0 is the first one')
    return None if match is None else int(match[1])


def without_secrets(url: str) -> str:
    """A URL without user, password and query, for messages."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


def open_camera_device(number: int, name: str) -> cv2.VideoCapture:
    """Open a camera.

    Args:
        name: of the source, for the error message.

    Raises:
        InputError: it cannot be opened.
    """
    return _open(name, number)


def open_network_stream(url: str, name: str, stall_seconds: float | None) -> cv2.VideoCapture:
    """Open a network stream.

    Args:
        name: of the source, for the error message.
        stall_seconds: how long opening and reading may take; None has no limit.

    Raises:
        InputError: it cannot be opened.
    """
    if stall_seconds is None:
        return _open(name, url, cv2.CAP_FFMPEG, [])
    limit_ms = max(1, round(1000 * stall_seconds))
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
    return _open(name, url, cv2.CAP_FFMPEG, timeouts)


def captured_frames(capture: cv2.VideoCapture, name: str, closed: threading.Event) -> Iterator[Frame]:
    """Frames of a camera or network stream, with the times of their arrival.

    Args:
        name: of the source, for the error message.
        closed: set by another thread when no further frames are wanted.

    Raises:
        InputError: there is no further frame; such sources have no regular end.
    """
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


def _open(name: str, *arguments: Any) -> cv2.VideoCapture:
    with quiet_opencv():
        capture = cv2.VideoCapture(*arguments)
    if not capture.isOpened():
        capture.release()
        raise InputError(f"{name} cannot be opened")
    return capture
