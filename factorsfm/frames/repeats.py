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
# Share of the texture that changes in some of the new frames around, if one that changes by so little repeats. Where
# hardly anything moves, encoders at low rates leave most blocks of a frame as they were, and all of them now and then,
# mostly after a keyframe. Such a frame is new, and as evidence it costs nothing. In renders that move by a tenth of a
# pixel a frame less than 0.6 changes then with H.264, up to 0.9 with MPEG-4, MPEG-2 and VP9 at their lowest rates;
# where frames do repeat, and move by as little, 0.6 or more.
_CHANGED, _SOME_PERCENTILE = 0.6, 66.0  # of the new frames: repeats that were missed are among them
_BLOCK_PX, _EVERY = 16, 4  # as most codecs leave them; where one changes, one in four of its rows does
_FINE = 16  # steps of a grey level in the texture of a block, which ends at 16 levels: dark images count as well
_AROUND, _LEAST_AROUND = 8, 2  # new frames that a difference is compared with
_MOST_IN_A_ROW = 3  # animation on fours; a camera that stands for longer is no cadence
_COMPARED_PIXELS = 500_000  # of whole rows: enough for a mean


class RepeatDetector:
    """Recognises repeated frames one by one, without looking ahead."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._differences: deque[float] = deque(maxlen=_AROUND)  # of new frames
        self._changed: deque[float] = deque(maxlen=_AROUND)  # of their texture
        self._in_a_row = 0

    def push(self, grey: NDArray[np.uint8]) -> bool:
        """Whether a frame, (h, w), repeats the one before. Noise of the camera differs between any two new frames."""
        step = max(1, grey.size // _COMPARED_PIXELS)
        rows = np.ascontiguousarray(grey[::step])
        before, self._before = self._before, rows
        if before is None:
            return False
        change = cv2.absdiff(rows, before)
        difference = cv2.mean(change)[0]
        few = rows[::_EVERY]
        texture = cv2.absdiff(few[:, 1:], few[:, :-1])
        if self._is_repeat(difference, cv2.mean(texture)[0]):
            self._in_a_row += 1
            if self._in_a_row <= _MOST_IN_A_ROW:
                return True
            self._differences.clear()  # the camera stands: new frames differ as little from here on
        self._in_a_row = 0
        self._differences.append(difference)
        self._changed.append(_share_changed(change[::_EVERY], texture, max(1, _BLOCK_PX // (step * _EVERY))))
        return False

    def _is_repeat(self, difference: float, texture: float) -> bool:
        if len(self._differences) < _LEAST_AROUND or difference >= _REPEATED * float(np.median(self._differences)):
            return False
        if difference >= _MOVED_PX * texture:
            return False
        return float(np.percentile(self._changed, _SOME_PERCENTILE)) > _CHANGED


def _share_changed(change: NDArray[np.uint8], texture: NDArray[np.uint8], block_rows: int) -> float:
    """Share of the texture that lies in blocks with any change; `block_rows`: rows of a block."""
    width, height = max(1, texture.shape[1] // _BLOCK_PX), max(1, texture.shape[0] // block_rows)
    whole = (slice(height * block_rows), slice(width * _BLOCK_PX))  # to take the mean of whole blocks is fast
    changed, weight = (
        cv2.resize(pixels[whole], (width, height), interpolation=cv2.INTER_AREA)
        for pixels in (
            cv2.threshold(change, 0, 255, cv2.THRESH_BINARY)[1],
            cv2.convertScaleAbs(texture, alpha=_FINE),
        )
    )
    return float(weight[changed > 0].sum(dtype=np.float64) / max(weight.sum(dtype=np.float64), 1.0))
