"""Letterbox and pillarbox: black bars beside the picture, told from what is dark in it.

A bar reaches from one border of the image to the other, is black but for the noise of compression and a line of
subtitles, ends along one line of pixels beside a picture that is clearly brighter, has another one on the opposite
side, and is there in every frame. What is dark in the picture does all of that hardly ever.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.picture_area import PictureArea

_BRIGHTEST_BAR = 32  # grey levels: 16 where limited range is shown as if it were full
_LIT = 10  # grey levels over the bars, beyond the ringing of codecs in them
_BRIGHT = 16  # grey levels over the bars at their edges: a dim picture does not tell where it ends
_TOUCHED = 0.02  # share of the pixels of a line that noise lights
_CORNERS = 0.125  # share of a line at each of its ends to which subtitles do not reach
_TEXT = 0.4  # largest share of the pixels of a line that text covers
_EDGE_PX = 8  # a block of a codec, which blurs an edge
_EDGE_ENDS, _EDGE_LINE = 0.25, 0.5  # least share of a line that is bright where the picture begins: at its ends, in all
_LEAST_PX = 2  # of a bar; a line that is black at the border of an image is nothing to speak of
_ALONE = 0.03  # of the height or width: blanking and padding, which may be at one side only
_PICTURE = 0.15  # of the brightest line or column: text covers less
_COMPARED = 480  # pixels of a line that are looked at


class BarDetector:
    """Finds bars frame by frame, without looking ahead; one that the picture enters later was none."""

    def __init__(self) -> None:
        self._sides = [_Side() for _ in range(4)]  # left, right, top, bottom

    def push(self, grey: NDArray[np.uint8]) -> PictureArea | None:
        """The picture of a (h, w) frame and all before it; None if it fills the image."""
        height, width = grey.shape
        for side, lines in zip(self._sides, _edges(grey, [side.reach for side in self._sides]), strict=False):
            side.add(*lines)
        left, right, top, bottom = (side.width for side in self._sides)
        if (left == 0) != (right == 0) and left + right > _ALONE * width:
            left = right = 0
        if (top == 0) != (bottom == 0) and top + bottom > _ALONE * height:
            top = bottom = 0
        if not (left or right or top or bottom):
            return None
        return PictureArea(left, top, width - right, height - bottom)

    def state(self) -> list[tuple[int | None, int, bool]]:
        """What `restore` needs."""
        return [astuple(side) for side in self._sides]

    def restore(self, state: list[tuple[int | None, int, bool]]) -> None:
        """Go on where `state` was taken."""
        self._sides = [_Side(*side) for side in state]


@dataclass(slots=True)
class _Side:
    """One side of the images.

    Attributes:
        nearest: fewest dark lines of a frame; width: how many of them are a bar; entered: whether the picture has been
            seen in what was taken for a bar.
    """

    nearest: int | None = None
    width: int = 0
    entered: bool = False

    @property
    def reach(self) -> int | None:
        """How many lines of the next frame to look at, None for all: a bar is hardly wider than it was before."""
        return None if self.nearest is None else self.nearest + 2 * _EDGE_PX

    def add(self, dark: int, is_edge: bool) -> None:
        """Take a frame with so many dark lines; is_edge: whether these end along one line."""
        self.nearest = dark if self.nearest is None else min(self.nearest, dark)
        self.entered |= self.width > self.nearest + _EDGE_PX
        if self.entered:
            self.width = 0
        elif is_edge and _LEAST_PX <= dark <= self.nearest + _EDGE_PX:
            self.width = max(self.width, dark)


def _edges(grey: NDArray[np.uint8], reach: list[int | None]) -> list[tuple[int, bool]]:
    """Of left, right, top and bottom: how many lines are dark, and whether they end along one line; [] if all are.

    Args:
        reach: how many lines of each are looked at, None for all.
    """
    level = int(min(np.median(border) for border in (grey[0], grey[-1], grey[:, 0], grey[:, -1])))
    if level > _BRIGHTEST_BAR:
        return [(0, False)] * 4
    height, width = grey.shape
    columns, rows = grey[:: max(1, height // _COMPARED)].T, grey[:, :: max(1, width // _COMPARED)]
    lit = rows[:: max(1, height // _COMPARED)] > level + _LIT
    if not lit.any():
        return []
    # With bars on all sides, the ends of a line are those of the picture.
    across, along = _extent(_shares_of_true(lit, along=0)), _extent(_shares_of_true(lit))
    found: list[tuple[int, bool]] = []
    reaches = iter(reach)
    for lines, (first, last) in ((columns, along), (rows, across)):
        length = lines.shape[1]
        picture = lines[:, int(first * length) : max(int(first * length) + 1, int(last * length))]
        found += [_dark_lines(side[: next(reaches)], level) for side in (picture, picture[::-1])]
    return found


def _extent(lit: NDArray[np.float64]) -> tuple[float, float]:
    """First and last line that text alone does not light, as shares of all lines; lit: (n,) share of each."""
    places = np.flatnonzero(lit > _PICTURE * lit.max())
    return float(places[0]) / len(lit), float(places[-1] + 1) / len(lit)


def _dark_lines(lines: NDArray[np.uint8], level: int) -> tuple[int, bool]:
    """How many lines from the first on are dark but for text, and whether the picture begins there along one line."""
    lit, bright = _shares(lines > level + _LIT), _shares(lines > level + _BRIGHT)
    picture = np.flatnonzero((lit[0] > _TOUCHED) | (lit[1] > _TEXT))
    if not len(picture):
        return len(lines), False
    dark = int(picture[0])
    corners, whole = bright[:, dark : dark + _EDGE_PX].max(axis=1)
    return dark, bool(corners > _EDGE_ENDS and whole > _EDGE_LINE)


def _shares(above: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(2, n) shares of what is above a level, at the ends of n lines and in all of each."""
    end = max(1, round(_CORNERS * above.shape[1]))
    corners = 0.5 * (_shares_of_true(above[:, :end]) + _shares_of_true(above[:, -end:]))
    return np.stack([corners, _shares_of_true(above)])


def _shares_of_true(flags: NDArray[np.bool_], along: int = 1) -> NDArray[np.float64]:
    """Share of True along an axis of (m, n) flags; OpenCV counts them ten times as fast as numpy."""
    counts = cv2.reduce(flags.view(np.uint8), along, cv2.REDUCE_SUM, dtype=cv2.CV_32S)
    return np.asarray(counts.ravel() / flags.shape[along])
