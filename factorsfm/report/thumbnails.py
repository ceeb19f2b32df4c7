"""Thumbnails of the frames for the report, in bounded memory."""

from __future__ import annotations

import base64
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.export.footage import frames_of
from factorsfm.export.options import ExportOptions
from factorsfm.export.shot import Defaults, make_shot
from factorsfm.report.document import data_of
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.context import Closing
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

_WIDTH = 384
_QUALITY = 60  # of JPEG
_MOST = 240  # about 4 MB


class Thumbnails(Closing):
    """Small JPEGs of a stream of frames: of every frame, or in a long shot of every second, fourth, ... frame.

    Example:
        >>> with Thumbnails() as thumbnails:
        ...     thumbnails.add(np.zeros((270, 480, 3), np.uint8))
        >>> len(thumbnails.by_frame())
        1
    """

    def __init__(self, most: int = _MOST, width: int = _WIDTH) -> None:
        self._most, self._width = most, width
        self._kept: dict[int, Future[bytes]] = {}
        self._worker = ThreadPoolExecutor(1, "factorsfm-thumbnails")  # nobody waits for a picture
        self._added = 0
        self._step = 1

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add the next frame, (h, w, 3) BGR or (h, w) grey."""
        if self._added % self._step == 0:
            small = _halved(image) if _is_large(image, self._width) else image.copy()  # of a large image no copy waits
            self._kept[self._added] = self._worker.submit(thumbnail, small, self._width)
        self._added += 1
        if len(self._kept) > self._most:
            self._step *= 2
            self._kept = {position: jpeg for position, jpeg in self._kept.items() if position % self._step == 0}

    def close(self) -> None:
        """Let the thread go once it has made all pictures; no further frame can be added."""
        self._worker.shutdown()

    def by_frame(self) -> list[bytes | None]:
        """One entry per added frame, None for frames without a thumbnail."""
        return [self._kept[k].result() if k in self._kept else None for k in range(self._added)]

    def state(self) -> dict[str, Any]:
        """The state for `restore`."""
        kept = {position: np.frombuffer(jpeg.result(), np.uint8) for position, jpeg in self._kept.items()}
        return {"kept": kept, "added": self._added, "step": self._step}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        self._kept = {position: _done(jpeg.tobytes()) for position, jpeg in state["kept"].items()}
        self._added, self._step = state["added"], state["step"]

    def attach(self, frames: Sequence[FrameResult]) -> None:
        """Give the frames their thumbnails.

        Args:
            frames: the added ones, in the same order."""
        for frame, jpeg in zip(frames, self.by_frame(), strict=True):
            frame.thumbnail = jpeg


def thumbnail(image: NDArray[np.uint8], width: int = _WIDTH) -> bytes:
    """A JPEG at most so wide; large images are halved first, which is fast."""
    while _is_large(image, width):
        image = _halved(image)
    if image.shape[1] > width:
        size = width, max(1, round(image.shape[0] * width / image.shape[1]))
        image = np.asarray(cv2.resize(image, size), np.uint8)
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return jpeg.tobytes()


def _is_large(image: NDArray[np.uint8], width: int) -> bool:
    return bool(image.shape[1] >= 2 * width)


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = max(1, image.shape[0] // 2), image.shape[1] // 2
    even = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _done(jpeg: bytes) -> Future[bytes]:
    done: Future[bytes] = Future()
    done.set_result(jpeg)
    return done


def take_from_report(result: Reconstruction, report: Path) -> None:
    """Give a result that was read back the thumbnails of its report, as far as there are some."""
    try:
        content = data_of(report.read_text(encoding="utf-8"))
        pictures = dict(zip(content["frame"], content["thumbnail"], strict=True))
        for frame in result.frames:
            kept = pictures.get(frame.index)
            frame.thumbnail = base64.b64decode(kept, validate=True) if kept else None
    except (OSError, ValueError, LookupError, TypeError) as error:  # a report without pictures is one, too
        logger.info("no thumbnails: %s", error)


def retake(result: Reconstruction, footage: Path | None = None, width: int = _WIDTH) -> None:
    """Give a result that was read back its thumbnails, if its footage is at hand.

    Args:
        footage: the shot, see `ExportOptions.footage`; width: of the thumbnails, pixels.

    Raises:
        InputError: the footage given is not that of the shot.
    """
    try:
        shot = make_shot(result, ExportOptions(footage=footage), Defaults())
        if shot.footage is None:
            return
        with Thumbnails(width=width) as thumbnails:
            for image in frames_of(shot, shot.in_footage):
                thumbnails.add(image.image)
    except InputError as error:
        if footage is not None:
            raise
        # a report without pictures is one, too
        logger.info("no thumbnails: %s", error)
        return
    for frame, jpeg in zip(result.frames[: len(shot.in_footage)], thumbnails.by_frame(), strict=True):
        frame.thumbnail = jpeg
