"""Shot boundaries, found while the frames arrive: hard cuts, fades through black or white, and dissolves.

Blocks of a small grey copy of the last frame are looked up in the new one by normalised correlation, which a change of
exposure leaves alone, in two ways: each on its own in its neighbourhood, and all with one common displacement in the
whole image. An actor who passes close by disturbs the second, a fast pan the first, and a cut both.

In a dissolve, every frame is nearly the last one. But a frame in its middle is a weighted sum of one before and one
after, block by block, and neither of these alone comes close.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.frames.likeness import View, blend, dissimilarity
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError

_BLANK = 0.1  # share of the blocks with texture; with less the frame is black, white or flat

_CUT = 0.12  # dissimilarity that no motion of a camera reaches between two frames of a video ...
_ABOVE_MEDIAN = 3.0  # ... and how many times that of the frames before, where the motion is always large
_HISTORY = 12  # frames
_DARK = 12  # blank frames after which a moving camera makes twice the difference
_CLEAR, _CLEAR_SHARE = 8.0, 0.5  # contrast of what is compared: grey levels, or a share of the highest not long before
_FADED = 4.0  # contrast, grey levels, of a view that shows too little to be compared unless the others are like it ...
_FADE = 12  # ... for as many frames at most
_INTERRUPTION = 4  # frames; where the view is back after no more than these, it was a flash or a damaged frame

_SPANS = (4, 8)  # frames from the middle of a dissolve to what is compared before and after
_APART = 0.2  # dissimilarity of these two
_ALONE, _TOGETHER = 0.9, 0.85  # variance that one of them may explain at most, and both must explain at least ...
_LEFT = 0.3  # ... so that this share of what one leaves, at most, is left by both
_CONFIRMED = 2  # frames in a row that say so
_SETTLED = 0.03  # dissimilarity to the frame four before, when the dissolve is over ...
_DISSOLVE = 12  # ... or after so many frames


@dataclass(frozen=True, slots=True)
class ShotUpdate:
    """What a frame is to the shots.

    Attributes:
        index: frames pushed before this one.
        shot: number of the shot that the frame belongs to, from 0; None where it is blank or nearly, or shows two in
            the second half of a dissolve. A new shot has a number of its own. After an interruption of at most four
            frames the old number comes back, and the number that the interruption had is void.
        starts: whether this is the first frame of a new shot.
        dissimilarity: to the last frame that was not blank, about 0 to 1; NaN where there is nothing to compare.
        reason: one sentence on a beginning, a return or a frame without a shot; empty where the shot just goes on.
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
    history: deque[float] = field(default_factory=lambda: deque(maxlen=_HISTORY))
    recent: deque[View] = field(default_factory=lambda: deque(maxlen=2 * max(_SPANS) + 1))  # without a gap
    blended: int = 0  # frames in a row that end a dissolve
    dissolving: int = 0  # frames since a dissolve is certain

    def clear(self) -> tuple[View, int]:
        """The newest view that has not faded, and how many frames came since."""
        contrasts = [view.contrast for view in self.recent]
        enough = min(_CLEAR, _CLEAR_SHARE * max(contrasts))
        place = max(k for k, contrast in enumerate(contrasts) if contrast >= enough)
        return self.recent[place], len(contrasts) - 1 - place

    def threshold(self, gap: int) -> float:
        """Largest dissimilarity of a frame that goes on with the shot after `gap` others."""
        usual = _ABOVE_MEDIAN * statistics.median(self.history) if self.history else 0.0
        return max(_CUT, usual) * (1.0 + min(gap / _DARK, 1.0))

    def is_dissolving(self) -> bool:
        """Whether some frame not long ago was a blend of others, or the view still changes since."""
        if self.dissolving:
            return (
                self.dissolving < _DISSOLVE and dissimilarity(self.recent[-1 - min(_SPANS)], self.recent[-1]) > _SETTLED
            )
        self.blended = self.blended + 1 if any(map(self._shows_blend, _SPANS)) else 0
        return self.blended >= _CONFIRMED

    def _shows_blend(self, span: int) -> bool:
        if len(self.recent) <= 2 * span:
            return False
        first, middle, last = (self.recent[-1 - back] for back in (2 * span, span, 0))
        if dissimilarity(first, last) < _APART:
            return False
        alone, together = blend(first, middle, last)
        return alone < _ALONE and together > _TOGETHER and 1.0 - together < _LEFT * (1.0 - alone)


class CutDetector:
    """Finds the shots of a video frame by frame, without looking ahead and in bounded memory.

    Found are hard cuts, fades through black or white: the shot ends where the image has gone blank, the next begins
    where there is something to see again; and dissolves of about six frames to a second: the shot ends in the middle,
    the next begins when the view has settled. A black or blown-out stretch with the same view before and after is no
    cut, nor are up to four frames of something else. Not found are dissolves while the camera moves fast, wipes, and
    cuts to almost the same view. Taken for cuts are jumps of more than about a tenth of the image from frame to frame,
    and somebody who fills half of it within a few frames. Frames must come from a video: photographs taken far apart
    differ as much as two shots do.

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
        view = View.of(image)
        textured, blocks = int(view.textured.sum()), len(view.textured)
        if textured < _BLANK * blocks:
            return ShotUpdate(index, None, False, float("nan"), f"blank: {textured} of {blocks} blocks show texture")
        if self._has_faded(index, view):
            return ShotUpdate(index, None, False, float("nan"), f"faded: contrast {view.contrast:.1f} grey levels")
        if self._shot is None:
            return self._begin(index, view, float("nan"), "first frame that shows something")
        return self._compare(index, view, self._shot)

    def _has_faded(self, index: int, view: View) -> bool:
        """Whether too little is left, or back, to tell whether it is the same view."""
        shot = self._shot
        if shot is None or view.contrast >= _FADED or index - shot.end > _FADE:
            return False
        return view.contrast < _CLEAR_SHARE * shot.clear()[0].contrast

    def _compare(self, index: int, view: View, shot: _Shot) -> ShotUpdate:
        if (before := self._interrupted) is not None:
            gap = index - before.end - 1
            reference, age = before.clear()
            if gap > _INTERRUPTION:
                self._interrupted = None
            elif (back := dissimilarity(reference, view)) < before.threshold(gap + age):
                before.end = index
                before.recent.clear()
                before.recent.append(view)
                self._shot, self._interrupted = before, None
                return ShotUpdate(index, before.number, False, back, f"the view is back after {gap} other frames")
        gap = index - shot.end - 1
        reference, age = shot.clear()
        difference, threshold = dissimilarity(reference, view), shot.threshold(gap + age)
        if difference < threshold:
            return self._go_on(index, view, shot, difference, gap)
        self._interrupted = self._interrupted or shot
        kind = f"another view after {gap} blank frames" if gap else "hard cut"
        return self._begin(index, view, difference, f"{kind}: dissimilarity {difference:.2f}, limit {threshold:.2f}")

    def _go_on(self, index: int, view: View, shot: _Shot, difference: float, gap: int) -> ShotUpdate:
        shot.history.append(difference)
        shot.end = index
        if gap:
            shot.recent.clear()
        shot.recent.append(view)
        if gap:
            return ShotUpdate(index, shot.number, False, difference, f"the view is back after {gap} blank frames")
        if shot.is_dissolving():
            shot.dissolving += 1
            return ShotUpdate(index, None, False, difference, "dissolve: the last frames blend two views")
        if shot.dissolving:
            self._interrupted = None
            return self._begin(index, view, difference, f"dissolve: the view has changed {shot.dissolving} frames ago")
        return ShotUpdate(index, shot.number, False, difference)

    def _begin(self, index: int, view: View, difference: float, reason: str) -> ShotUpdate:
        self._shot = _Shot(self._shots, index)
        self._shot.recent.append(view)
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
