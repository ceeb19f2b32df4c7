"""Shot boundaries, found while the frames arrive: hard cuts, fades through black or white, and dissolves.

A frame belongs to the shot while its dissimilarity to the last one stays below a threshold (`block_matching`). In a
dissolve every frame is nearly the last one; but a frame in its middle is, block by block, a weighted sum of a frame
before and a frame after it, and neither of these alone comes close.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.block_matching import Thumbnail, dissimilarity, dissolve_variances
from factorsfm.frames.frame import Frame
from factorsfm.frames.timing import Pace
from factorsfm.support.errors import InputError
from factorsfm.support.pace import frames_in

T = TypeVar("T")

_BLANK_SHARE = 0.1  # share of the blocks with texture, below which a frame is black, white or flat

# Hard cuts: the dissimilarity that camera motion does not reach between two frames.
_CUT_DISSIMILARITY = 0.12
_CUT_TIMES_MEDIAN = 3.0  # the same as a multiple of the median of the last frames, if their motion is large
_HISTORY_FRAMES = 12  # of that median
_DOUBLING_SECONDS = 0.5  # gap after which the threshold is twice as large, because the camera moves on meanwhile

# Fades: frames of low contrast are not compared.
_FULL_CONTRAST = 8.0  # grey levels: enough for a frame to be compared with
_FULL_CONTRAST_SHARE = 0.5  # of the highest contrast of the last frames: also enough
_FADED_CONTRAST = 4.0  # grey levels, below which a frame is faded if the frames before had more contrast
_FADE_SECONDS = 0.5  # longest fade; after it, a frame of low contrast is compared

_INTERRUPTION_SECONDS = 1.0 / 6.0  # if the view is back after no more than that, it was a flash or damage

# Dissolves.
_SPANS = (1.0 / 6.0, 1.0 / 3.0)  # seconds from the middle of a dissolve to the two frames that blend in it
_ENDS_DISSIMILARITY = 0.2  # least dissimilarity of these two
_MOST_ALONE = 0.9  # largest share of variance that one of them explains alone
_LEAST_TOGETHER = 0.85  # smallest share that both explain together
_REST_RATIO = 0.3  # largest ratio of what both leave unexplained to what one alone leaves
_CONFIRMATIONS = 2  # frames in a row that must show a dissolve
_SETTLED_DISSIMILARITY = 0.03  # to the frame the shorter span before, below which the dissolve is over
_DISSOLVE_SECONDS = 0.5  # after which it is over in any case


@dataclass(frozen=True, slots=True)
class ShotUpdate:
    """The shot of a frame.

    Attributes:
        index: number of frames pushed before this one.
        shot: number of the frame's shot, from 0. None if the frame is blank or faded, or in the second half of a
            dissolve. Every new shot takes the next number. If the old view is back after at most four other frames, so
            is its number, and the number of these frames is void.
        starts: whether this is the first frame of a new shot.
        dissimilarity: to the last frame that was not blank, about 0 to 1; NaN if there is nothing to compare.
        reason: one sentence if the shot starts or comes back, or if the frame has none; otherwise empty.
    """

    index: int
    shot: int | None
    starts: bool
    dissimilarity: float
    reason: str = ""


@dataclass(slots=True)
class _Shot:
    """A shot so far: its number, its last frame, the dissimilarities and thumbnails of the last frames."""

    number: int
    end: int
    history: deque[float] = field(default_factory=lambda: deque(maxlen=_HISTORY_FRAMES))
    recent: deque[Thumbnail] = field(default_factory=deque)  # without a gap
    blended: int = 0  # frames in a row that show a dissolve
    dissolving: int = 0  # frames since a dissolve was confirmed

    def reference(self) -> tuple[Thumbnail, int]:
        """The newest thumbnail of full contrast, and the number of frames since."""
        contrasts = [thumbnail.contrast for thumbnail in self.recent]
        enough = min(_FULL_CONTRAST, _FULL_CONTRAST_SHARE * max(contrasts))
        place = max(k for k, contrast in enumerate(contrasts) if contrast >= enough)
        return self.recent[place], len(contrasts) - 1 - place

    def add(self, thumbnail: Thumbnail, rate: float) -> None:
        """Remember the newest frame, and no more of them than a dissolve needs; `rate`: frames a second."""
        self.recent.append(thumbnail)
        while len(self.recent) > 2 * frames_in(max(_SPANS), rate) + 1:
            self.recent.popleft()

    def threshold(self, gap: int, rate: float) -> float:
        """Largest dissimilarity of a frame of the same shot, `gap` frames after the one it is compared with."""
        usual = _CUT_TIMES_MEDIAN * statistics.median(self.history) if self.history else 0.0
        return max(_CUT_DISSIMILARITY, usual) * (1.0 + min(gap / frames_in(_DOUBLING_SECONDS, rate), 1.0))

    def is_dissolving(self, rate: float) -> bool:
        """Whether a dissolve is confirmed by the newest frames, or was confirmed and is not over."""
        spans = [frames_in(span, rate) for span in _SPANS]
        if self.dissolving:
            before, newest = self.recent[max(-1 - spans[0], -len(self.recent))], self.recent[-1]
            settled = dissimilarity(before, newest) <= _SETTLED_DISSIMILARITY
            return self.dissolving < frames_in(_DISSOLVE_SECONDS, rate) and not settled
        self.blended = self.blended + 1 if any(map(self._is_blend, spans)) else 0
        return self.blended >= _CONFIRMATIONS

    def _is_blend(self, span: int) -> bool:
        """Whether the frame `span` frames ago is a blend of the newest frame and of the one 2 `span` frames ago."""
        if len(self.recent) <= 2 * span:
            return False
        first, middle, last = (self.recent[-1 - back] for back in (2 * span, span, 0))
        if dissimilarity(first, last) < _ENDS_DISSIMILARITY:
            return False
        alone, together = dissolve_variances(first, middle, last)
        return alone < _MOST_ALONE and together > _LEAST_TOGETHER and 1.0 - together < _REST_RATIO * (1.0 - alone)


class CutDetector:
    """Finds the shots of a video frame by frame, without looking ahead and in bounded memory.

    It finds hard cuts; fades through black or white, where the shot ends at the first blank frame and the next begins
    at the first frame that shows something; and dissolves of about six frames to a second, where the shot ends in the
    middle and the next begins when the view no longer changes.

    A black or blown-out stretch with the same view before and after it is no cut, nor is a sixth of a second of
    something else.

    It misses dissolves while the camera moves fast, wipes, and cuts to almost the same view. It takes a jump of more
    than about a tenth of the image for a cut, and a person who fills half of the image within a few frames. Photographs
    taken far apart differ as much as two shots do, so frames must come from a video.

    Example:
        >>> detector = CutDetector()
        >>> for frame in factorsfm.read_frames("film.mp4"):  # doctest: +SKIP
        ...     if detector.push(frame).starts:
        ...         print(frame.index)
    """

    def __init__(self) -> None:
        self._pushed, self._shots, self._pace = 0, 0, Pace()
        self._size: tuple[int, ...] = ()
        self._shot: _Shot | None = None
        self._interrupted: _Shot | None = None  # the shot before, while its view may come back

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
        if isinstance(frame, Frame):
            self._pace.push(frame.index, frame.timestamp)
        index, self._pushed = self._pushed, self._pushed + 1
        thumbnail = Thumbnail.of(image)
        textured, blocks = int(thumbnail.textured.sum()), len(thumbnail.textured)
        if textured < _BLANK_SHARE * blocks:
            return ShotUpdate(index, None, False, float("nan"), f"blank: {textured} of {blocks} blocks show texture")
        if self._has_faded(index, thumbnail):
            reason = f"faded: contrast {thumbnail.contrast:.1f} grey levels"
            return ShotUpdate(index, None, False, float("nan"), reason)
        if self._shot is None:
            return self._begin(index, thumbnail, float("nan"), "first frame that shows something")
        return self._compare(index, thumbnail, self._shot)

    def _frames(self, seconds: float) -> int:
        """How many frames come in a time."""
        return frames_in(seconds, self._pace.rate)

    def _has_faded(self, index: int, thumbnail: Thumbnail) -> bool:
        """Whether the contrast is too low, beside that of the shot, to compare the views."""
        shot = self._shot
        if shot is None or thumbnail.contrast >= _FADED_CONTRAST or index - shot.end > self._frames(_FADE_SECONDS):
            return False
        return thumbnail.contrast < _FULL_CONTRAST_SHARE * shot.reference()[0].contrast

    def _compare(self, index: int, thumbnail: Thumbnail, shot: _Shot) -> ShotUpdate:
        if (returned := self._resume(index, thumbnail)) is not None:
            return returned
        gap = index - shot.end - 1
        reference, age = shot.reference()
        difference, threshold = dissimilarity(reference, thumbnail), shot.threshold(gap + age, self._pace.rate)
        if difference < threshold:
            return self._go_on(index, thumbnail, shot, difference, gap)
        self._interrupted = self._interrupted or shot
        kind = f"another view after {gap} blank frames" if gap else "hard cut"
        reason = f"{kind}: dissimilarity {difference:.2f}, limit {threshold:.2f}"
        return self._begin(index, thumbnail, difference, reason)

    def _resume(self, index: int, thumbnail: Thumbnail) -> ShotUpdate | None:
        """Go on with the shot before, if there is an interruption and its view is back; None if it is not."""
        before = self._interrupted
        if before is None:
            return None
        gap = index - before.end - 1
        reference, age = before.reference()
        if gap > self._frames(_INTERRUPTION_SECONDS):
            self._interrupted = None
            return None
        difference = dissimilarity(reference, thumbnail)
        if difference < before.threshold(gap + age, self._pace.rate):
            before.end = index
            before.recent.clear()
            before.add(thumbnail, self._pace.rate)
            self._shot, self._interrupted = before, None
            return ShotUpdate(index, before.number, False, difference, f"the view is back after {gap} other frames")
        return None

    def _go_on(self, index: int, thumbnail: Thumbnail, shot: _Shot, difference: float, gap: int) -> ShotUpdate:
        """Add the frame to the shot, and look for a dissolve that ends it."""
        shot.history.append(difference)
        shot.end = index
        if gap:
            shot.recent.clear()
        shot.add(thumbnail, self._pace.rate)
        if gap:
            return ShotUpdate(index, shot.number, False, difference, f"the view is back after {gap} blank frames")
        if shot.is_dissolving(self._pace.rate):
            shot.dissolving += 1
            return ShotUpdate(index, None, False, difference, "dissolve: the last frames blend two views")
        if shot.dissolving:
            self._interrupted = None
            reason = f"dissolve: the view has changed {shot.dissolving} frames ago"
            return self._begin(index, thumbnail, difference, reason)
        return ShotUpdate(index, shot.number, False, difference)

    def _begin(self, index: int, thumbnail: Thumbnail, difference: float, reason: str) -> ShotUpdate:
        self._shot = _Shot(self._shots, index)
        self._shot.add(thumbnail, self._pace.rate)
        self._shots += 1
        return ShotUpdate(index, self._shot.number, True, difference, reason)


def by_shot(frames: Iterable[Frame], new: Callable[[], T], add: Callable[[T, Frame], None]) -> list[T]:
    """Collect the frames of each shot, without those that belong to none.

    Args:
        new: makes an empty collection; add: adds a frame to one.
    """
    detector = CutDetector()
    found: dict[int, T] = {}
    for frame in frames:
        shot = detector.push(frame).shot
        if shot is None:
            continue
        found = {number: part for number, part in found.items() if number <= shot}  # later numbers are now void
        add(found.setdefault(shot, new()), frame)
    return [part for _, part in sorted(found.items())]
