"""Frames that show the image of the frame before once more: film in video, animation, dropped frames of a recording."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

# Mean difference of a repeated frame to the one before, over that of new frames around it. In the rendered and real
# shots at hand, frames that are new have 0.38 or more, also where a hand-held camera all but stops for a frame; with
# H.264, VP9 or ProRes those that repeat have 0.00 to 0.08 if there is grain or motion. Where compression has taken
# both, and with intra-only codecs at low rates, repeats reach 0.2 to 0.7 and pass as new: that costs little.
_REPEATED = 0.2
# The same over the mean difference of neighbouring pixels: had the image moved, then by no more than so many pixels.
# That bounds what a wrong verdict costs, as after a cut or a flash, beside which everything seems to rest.
_MOVED_PX = 0.1
_AROUND, _LEAST_AROUND = 8, 2  # new frames that a difference is compared with
_MOST_IN_A_ROW = 3  # animation on fours; a camera that stands for longer is no cadence
_COMPARED_PIXELS = 500_000  # of whole rows: enough for a mean


class RepeatDetector:
    """Recognises repeated frames one by one, without looking ahead."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._differences: deque[float] = deque(maxlen=_AROUND)  # of new frames
        self._in_a_row = 0

    def push(self, grey: NDArray[np.uint8]) -> bool:
        """Whether a frame, (h, w), repeats the one before. Noise of the camera differs between any two new frames."""
        rows = np.ascontiguousarray(grey[:: max(1, grey.size // _COMPARED_PIXELS)])
        before, self._before = self._before, rows
        if before is None:
            return False
        difference = _mean_difference(rows, before)
        if self._is_repeat(difference, rows):
            self._in_a_row += 1
            if self._in_a_row <= _MOST_IN_A_ROW:
                return True
            self._differences.clear()  # the camera stands: new frames differ as little from here on
        self._in_a_row = 0
        self._differences.append(difference)
        return False

    def _is_repeat(self, difference: float, rows: NDArray[np.uint8]) -> bool:
        if len(self._differences) < _LEAST_AROUND or difference >= _REPEATED * float(np.median(self._differences)):
            return False
        return difference < _MOVED_PX * _mean_difference(rows[:, 1:], rows[:, :-1])


def _mean_difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return cv2.mean(cv2.absdiff(a, b))[0]
