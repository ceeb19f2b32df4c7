"""Damaged video: which numbers its frames have, and what is said of those that are missing."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np

from factorsfm.support.first_few import first_few

logger = logging.getLogger(__name__)

_EVEN = 0.2  # of the interval: containers round times
_MOST_NAMED = 5  # missing frames that are named
_LONGEST_GAP = 10.0  # seconds: a longer one is no damage but a splice of two recordings
_ANNOUNCED_SHARE = 0.95  # of what the container announces, which is not exact

# What a codec with arithmetic coding makes of damaged bytes without a word: blocks of noise, which all frames up to the
# next keyframe take over. Neighbouring pixels then differ by more than 40 of 255 in 8 to 45 % of an image, 3 times as
# many as in the keyframe and more. In sound renders and films they do in 1 to 4 %, at most twice as many.
_EDGE, _NOISY_SHARE, _NOISY_TIMES = 40, 0.08, 3.0
_LEAST_SHARE = 0.001  # of the keyframe: one without edges says nothing
_COMPARED_PIXELS = 100_000  # of whole rows


class Numbers:
    """Numbers the frames of a video; those that damage has taken keep theirs, and are missing.

    Times tell how many are missing, where frames came evenly before. Without damage frames are counted one by one,
    whatever their times.

    Args:
        interval: seconds from a frame to the next, 0 if unknown.
    """

    def __init__(self, interval: float) -> None:
        self._number, self._last, self._interval = -1, -1, interval
        self._even, self._damaged = interval > 0.0, False
        self._timed: tuple[int, float] | None = None  # the last frame with a time
        self._missing: list[int] = []

    def of(self, first: int, frames: Iterable[tuple[av.VideoFrame, bool]]) -> Iterator[tuple[int, av.VideoFrame]]:
        """Numbers and frames, without corrupt ones.

        Args:
            first: number of the first frame; frames: as `decoded_with_damage` gives them.
        """
        self._number = first - 1
        frames = itertools.dropwhile(lambda found: found[0].is_corrupt, frames)  # the file begins behind them
        for frame, damaged in frames:
            self._damaged |= damaged
            step = self._step(frame.time)
            self._missing += range(self._number + 1, self._number + step)
            self._number += step
            if frame.time is not None:
                self._timed = self._number, frame.time
            if frame.is_corrupt:
                self._missing.append(self._number)
            else:
                self._last = self._number
                yield self._number, frame

    def _step(self, time: float | None) -> int:
        """How far the number of the next frame is from that of the last one."""
        if time is None or self._timed is None or not self._even:
            return 1
        number, before = self._timed
        steps = number + (time - before) / self._interval - self._number
        if not self._damaged:
            self._even = abs(steps - 1.0) < _EVEN
            return 1
        return max(round(steps), 1) if time - before < _LONGEST_GAP else 1

    def warn(self, path: Path) -> None:
        """Log a warning if frames are missing between others."""
        between = [number for number in self._missing if number < self._last]
        if between:
            logger.warning(
                "%s is damaged; frames that cannot be read: %d (%s); the others keep their numbers",
                path, len(between), first_few(between, _MOST_NAMED),
            )  # fmt: skip


class NoiseWatch:
    """Looks for damage that the decoder does not report. No frame is left out for it: sound ones can look so."""

    def __init__(self) -> None:
        self._keyframe: float | None = None  # share of its pixels that differ much from their neighbours
        self._noisy: list[int] = []

    def push(self, number: int, frame: av.VideoFrame) -> None:
        """Look at the next frame. Those of codecs without differences between frames are all keyframes."""
        if not frame.format.is_planar or frame.format.is_big_endian:
            return
        share = _edge_share(frame)
        if self._keyframe is None or frame.key_frame:
            self._keyframe = max(share, _LEAST_SHARE)
        elif share > max(_NOISY_SHARE, _NOISY_TIMES * self._keyframe):
            self._noisy.append(number)

    def warn(self, path: Path) -> None:
        """Log a warning if frames look damaged."""
        if self._noisy:
            logger.warning(
                "%s may be damaged: %d frames (%s) have many times the edges of the keyframe before them; poses from "
                "there to the next keyframe may be wrong",
                path, len(self._noisy), first_few(self._noisy, _MOST_NAMED),
            )  # fmt: skip


def _edge_share(frame: av.VideoFrame) -> float:
    """Share of the pixels of the first plane that differ much from their neighbour in the row."""
    plane, bits = frame.planes[0], frame.format.components[0].bits
    rows = np.frombuffer(memoryview(plane), np.uint8 if bits <= 8 else np.uint16).reshape(plane.height, -1)
    rows = np.ascontiguousarray(rows[:: max(1, plane.height * plane.width // _COMPARED_PIXELS), : plane.width])
    return float((cv2.absdiff(rows[:, 1:], rows[:, :-1]) > _EDGE << max(bits - 8, 0)).mean())


def warn_if_short(path: Path, frames: tuple[int, int], seconds: tuple[float, float]) -> None:
    """Log a warning if a file clearly ends before its container announces.

    Args:
        frames, seconds: how many could be read, and how many the container announces, 0 if it does not say.
    """
    count, announced = frames
    if count < _ANNOUNCED_SHARE * announced - 1.0:
        logger.warning(
            "%s: only %d of the %d frames that the container announces can be read; the others are damaged, missing, "
            "or hidden by an edit",
            path, count, announced,
        )  # fmt: skip
    elif not announced and seconds[0] < _ANNOUNCED_SHARE * seconds[1]:
        logger.warning(
            "%s: only %.1f of the %.1f seconds that the container announces can be read; the others are damaged or "
            "missing",
            path, *seconds,
        )  # fmt: skip
