"""Shot boundaries, found while the frames arrive: hard cuts, and fades through black or white.

Blocks of a small grey copy of the last frame are looked up in the new one by normalised correlation, which a change of
exposure leaves alone, in two ways: each on its own in its neighbourhood, and all with one common displacement in the
whole image. An actor who passes close by disturbs the second, a fast pan the first, and a cut both.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.errors import InputError
from factorsfm.frames import Frame, read_frames

Array = NDArray[np.float32]

_LONGER_SIDE = 96  # of the small copy, pixels; all lengths below are in its pixels
_BLOCK = 18
_NEAR = 9  # how far a block may move by itself
_FAR = 0.35  # how far all blocks may move together, share of the image
_SPREAD = 3  # how far a block may be off the common displacement: parallax, rotation, zoom
_OVERLAP = 0.6  # share of the blocks that must still be in view after the common displacement
_TEXTURE = 2.0  # grey levels, standard deviation in a block; with less it shows nothing to compare
_BLANK = 0.1  # share of the blocks with texture; with less the frame is black, white or flat

_CUT = 0.12  # dissimilarity that no motion of a camera reaches between two frames of a video ...
_ABOVE_MEDIAN = 3.0  # ... and how many times that of the frames before, where the motion is always large
_HISTORY = 12  # frames
_DARK = 12  # blank frames after which a moving camera makes twice the difference
_INTERRUPTION = 4  # frames; where the view is back after no more than these, it was a flash or a damaged frame


@dataclass(frozen=True, slots=True)
class ShotUpdate:
    """What a frame is to the shots.

    Attributes:
        index: frames pushed before this one.
        shot: number of the shot that the frame belongs to, from 0; None where it is blank. A new shot has a number of
            its own. After an interruption of at most four frames the old number comes back, and the number that the
            interruption had is void.
        starts: whether this is the first frame of a new shot.
        dissimilarity: to the last frame that was not blank, about 0 to 1; NaN where there is nothing to compare.
        reason: one sentence on a beginning, a return or a blank frame; empty where the shot just goes on.
    """

    index: int
    shot: int | None
    starts: bool
    dissimilarity: float
    reason: str = ""


@dataclass(slots=True)
class _Shot:
    number: int
    end: int  # its last frame
    view: _View
    history: deque[float] = field(default_factory=lambda: deque(maxlen=_HISTORY))

    def threshold(self, gap: int) -> float:
        """Largest dissimilarity of a frame that goes on with the shot after `gap` others."""
        usual = _ABOVE_MEDIAN * statistics.median(self.history) if self.history else 0.0
        return max(_CUT, usual) * (1.0 + min(gap / _DARK, 1.0))


class CutDetector:
    """Finds the shots of a video frame by frame, without looking ahead and in bounded memory.

    Found are hard cuts, and fades through black or white: the shot ends where the image has gone blank, the next begins
    where there is something to see again. A black or blown-out stretch with the same view before and after is no cut,
    nor are up to four frames of something else. Not found are dissolves from one view straight into another, and cuts
    to almost the same view. Taken for cuts are jumps of more than about a tenth of the image from frame to frame, and
    somebody who fills half of it within a few frames. Frames must come from a video: photographs taken far apart differ
    as much as two shots do.

    Example:
        >>> detector = CutDetector()
        >>> for frame in factorsfm.read_frames("film.mp4"):  # doctest: +SKIP
        ...     if detector.push(frame).starts:
        ...         print(frame.index)
    """

    def __init__(self) -> None:
        self._pushed = 0
        self._shots = 0
        self._size: tuple[int, ...] = ()
        self._shot: _Shot | None = None
        self._interrupted: _Shot | None = None  # the shot before, while it may still come back

    def push(self, frame: Frame | NDArray[np.uint8]) -> ShotUpdate:
        """Take the next frame.

        Args:
            frame: a `Frame`, or an image (h, w, 3) BGR or (h, w) grey, uint8.

        Raises:
            InputError: its size differs from that of the frames before.
        """
        image = frame.image if isinstance(frame, Frame) else frame
        size = image.shape[:2]
        if self._size not in ((), size):
            raise InputError(f"frame {self._pushed} has shape {size}, expected {self._size} as the frames before")
        self._size = size
        index, self._pushed = self._pushed, self._pushed + 1
        view = _View.of(image)
        textured, blocks = int(view.textured.sum()), len(view.textured)
        if textured < _BLANK * blocks:
            return ShotUpdate(index, None, False, float("nan"), f"blank: {textured} of {blocks} blocks show texture")
        if self._shot is None:
            return self._begin(index, view, float("nan"), "first frame that shows something")
        return self._compare(index, view, self._shot)

    def _compare(self, index: int, view: _View, shot: _Shot) -> ShotUpdate:
        if (before := self._interrupted) is not None:
            gap = index - before.end - 1
            if gap > _INTERRUPTION:
                self._interrupted = None
            elif (back := _dissimilarity(before.view, view)) < before.threshold(gap):
                before.end, before.view = index, view
                self._shot, self._interrupted = before, None
                return ShotUpdate(index, before.number, False, back, f"the view is back after {gap} other frames")
        gap = index - shot.end - 1
        difference, threshold = _dissimilarity(shot.view, view), shot.threshold(gap)
        if difference < threshold:
            shot.history.append(difference)
            shot.end, shot.view = index, view
            reason = f"the view is back after {gap} blank frames" if gap else ""
            return ShotUpdate(index, shot.number, False, difference, reason)
        self._interrupted = self._interrupted or shot
        kind = f"another view after {gap} blank frames" if gap else "hard cut"
        return self._begin(index, view, difference, f"{kind}: dissimilarity {difference:.2f}, limit {threshold:.2f}")

    def _begin(self, index: int, view: _View, difference: float, reason: str) -> ShotUpdate:
        self._shot = _Shot(self._shots, index, view)
        self._shots += 1
        return ShotUpdate(index, self._shot.number, True, difference, reason)


def find_shots(source: str | Path | Iterable[Frame | NDArray[np.uint8]], frames: slice | None = None) -> list[range]:
    """Shots of a video, each as the range of its frames, blank ones at either end left out.

    Args:
        source, frames: as in `read_frames`; the ranges count in the source.

    Raises:
        InputError: the source cannot be read.
    """
    detector = CutDetector()
    ends: dict[int, tuple[int, int]] = {}  # first and last frame by number
    for frame in read_frames(source, frames):
        shot = detector.push(frame).shot
        if shot is None:
            continue
        first = ends[shot][0] if shot in ends else frame.index
        ends = {number: pair for number, pair in ends.items() if number <= shot}  # the later ones were interruptions
        ends[shot] = (first, frame.index)
    return [range(first, last + 1) for _, (first, last) in sorted(ends.items())]


@dataclass(frozen=True, slots=True)
class _View:
    """Small grey copy of a frame, cut into a grid of blocks.

    Attributes:
        pixels: (h, w).
        deviation: (h, w) standard deviation of the block with this upper left corner, never below `_TEXTURE`.
        corners: (n, 2) x, y of the upper left corners of the blocks in the grid.
        blocks: (n, block height, block width) of mean 0, divided by their standard deviation and number of pixels.
        textured: (n,) whether the block shows something.
    """

    pixels: Array
    deviation: Array
    corners: NDArray[np.int64]
    blocks: Array
    textured: NDArray[np.bool_]

    @staticmethod
    def of(image: NDArray[np.uint8]) -> _View:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        scale = _LONGER_SIDE / max(grey.shape)
        width, height = (max(1, round(side * scale)) for side in grey.shape[::-1])
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small - small.mean(), (3, 3), 0)  # near 0 squares lose no digits
        size = (min(_BLOCK, width), min(_BLOCK, height))
        mean = cv2.boxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        square = cv2.sqrBoxFilter(small, cv2.CV_32F, size, anchor=(0, 0))
        deviation = np.sqrt(np.maximum(square - mean**2, _TEXTURE**2))
        corners = np.array([(x, y) for y in _grid(height) for x in _grid(width)])
        blocks = np.stack([small[y : y + size[1], x : x + size[0]] for x, y in corners])
        x, y = corners.T
        blocks = (blocks - mean[y, x, None, None]) / (deviation[y, x, None, None] * size[0] * size[1])
        return _View(small, deviation, corners, blocks, deviation[y, x] > _TEXTURE)


def _grid(length: int) -> range:
    """Where the blocks begin along a side."""
    count = max(1, length // _BLOCK)
    first = max(0, (length - count * _BLOCK) // 2)
    return range(first, first + count * _BLOCK, _BLOCK)


def _dissimilarity(first: _View, second: _View) -> float:
    """One minus the correlation of the blocks of `first` with what is found of them in `second`."""
    usable = np.flatnonzero(first.textured & second.textured)
    if len(usable) < _BLANK * len(first.blocks):
        return 1.0
    near = _correlations(first, second, usable, _NEAR, _NEAR)
    alone = 1.0 - float(np.median(near.max(axis=(1, 2))))
    if alone < 0.5 * _CUT:  # the usual case: no need to look farther
        return max(alone, 0.0)
    height, width = first.pixels.shape
    far = _correlations(first, second, usable, round(_FAR * width), round(_FAR * height))
    inside = np.isfinite(far)
    seen = inside.sum(axis=0)
    kernel = np.ones((2 * _SPREAD + 1, 2 * _SPREAD + 1), np.uint8)
    spread = np.stack([cv2.dilate(each, kernel) for each in far])
    mean = np.where(inside, spread, 0.0).sum(axis=0) / np.maximum(seen, 1)
    together = 1.0 - float(mean[seen >= _OVERLAP * len(usable)].max(initial=0.0))
    return min(alone, together)


def _correlations(first: _View, second: _View, chosen: NDArray[np.int64], reach_x: int, reach_y: int) -> Array:
    """Of chosen blocks of `first` with `second` at all displacements within reach.

    Returns:
        (blocks, 2 reach_y + 1, 2 reach_x + 1); minus infinity where the block would leave the image.
    """
    found = np.full((len(chosen), 2 * reach_y + 1, 2 * reach_x + 1), -np.inf, np.float32)
    height, width = second.pixels.shape
    block_height, block_width = first.blocks.shape[1:]
    for correlations, block, (x, y) in zip(found, first.blocks[chosen], first.corners[chosen], strict=True):
        left, right = max(0, x - reach_x), min(width - block_width, x + reach_x) + 1
        top, bottom = max(0, y - reach_y), min(height - block_height, y + reach_y) + 1
        window = second.pixels[top : bottom + block_height - 1, left : right + block_width - 1]
        covariance = cv2.matchTemplate(window, block, cv2.TM_CCORR)
        inside = (slice(top - y + reach_y, bottom - y + reach_y), slice(left - x + reach_x, right - x + reach_x))
        correlations[inside] = covariance / second.deviation[top:bottom, left:right]
    return found
