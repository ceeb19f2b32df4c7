"""What belongs to a shot in footage that was edited: between slates, bars and pieces of others, or none of several.

The cuts are those of a `CutDetector`. It takes large steps of one shot for cuts, too, such as those over frames that a
recorder has dropped; the images on both sides tell, since they show nearly the same view.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.cuts import CutDetector, by_shot
from factorsfm.frames.fields import Fields
from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.support.first_few import first_few

Grey = NDArray[np.uint8]

_LEAST_FRAMES = 8  # a third of a second; shorter and beside a shot four times as long, it is what a cut left over
_LEAST_SHARE = 0.25

# Shorter, too, and blurred beside the longest stretch, it is a whip pan. One over 200 pixels a frame has 0.37 of the
# sharpness of what follows; within a shot it changes by a twentieth.
_BLURRED = 0.5

# A picture that stands still. Rendered and real shots with a camera that hardly moves change by 70 grey levels and
# more, one on a support, waiting for take-off, by 5 (noise); bars and cards by up to 1, where they are compressed.
_STILL_WIDTH = 240  # pixels: grain averages out
_STILL_CHANGE, _STILL_PERCENTILE = 3.0, 95  # grey levels; a running clock on a slate is smaller than the rest

# One view on both sides of a step. Over 4 to 16 frames left out of rendered and real shots the detector saw cuts: the
# matches that one similarity explains are 28 to 414 and 37 % or more of all, have moved by up to 0.22 of the width, and
# their scale has changed by up to a fifth. Of set-ups in the same room (116 matches) it is 0.2 and more, or a quarter.
_SIDE, _FEATURES, _RATIO = 480, 1000, 0.8  # width of the images in pixels; SIFT keypoints; Lowe's ratio test
_TOLERANCE_PX = 12.0  # of a match beside the similarity, since the depths of a scene move unlike each other
_LEAST_MATCHES, _LEAST_MATCHED, _LARGEST_SHIFT, _LARGEST_ZOOM = 25, 0.35, 0.2, 1.2


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Frames that do not belong to the shot.

    Attributes:
        first, last: their numbers; `last` is one of them.
        reason: what they are, in words.
    """

    first: int
    last: int
    reason: str

    def holds(self, index: int) -> bool:
        """Whether a frame is one of them."""
        return self.first <= index <= self.last

    @property
    def said(self) -> str:
        """The numbers and the reason."""
        numbers = f"frame {self.first} is" if self.first == self.last else f"frames {self.first} to {self.last} are"
        return f"{numbers} {self.reason}"


@dataclass(frozen=True, slots=True)
class Edit:
    """The parts of footage that was cut.

    Attributes:
        starts: numbers of the first frames of the shots; one if it is a single shot.
        left_out: what is beside the shots, in order.
    """

    starts: tuple[int, ...]
    left_out: tuple[LeftOut, ...] = ()

    @property
    def cuts(self) -> str:
        """The cuts between the shots in words, with what to do."""
        first, *others = self.starts
        count = f"{len(others)} cut{'s' if len(others) > 1 else ''}"
        where = first_few(others, 5)
        return (
            f"{count}, before frame{'s' if len(others) > 1 else ''} {where}: these are {len(self.starts)} shots; "
            f"use batch, which solves each of them, or --frames for one, such as --frames {first}:{others[0]}"
        )


class AnotherView(Exception):
    """The frames go on with another view."""


def until_another_view(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The same frames, up to one with which a further shot may begin.

    Raises:
        AnotherView: there is one.
    """
    detector = CutDetector()
    for frame in frames:
        update = detector.push(frame)
        if update.starts and update.shot:
            raise AnotherView
        yield frame


@dataclass(slots=True)
class _Stretch:
    """Frames between two cuts.

    Attributes:
        indices: their numbers; begin, end: greys of the first and the last one.
        change: how much the picture changes (grey levels); sharpness: of the sharpest frame, in parts of its contrast.
    """

    indices: list[int] = field(default_factory=list)
    begin: Grey = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    end: Grey = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    change: float = 0.0
    sharpness: float = 0.0

    def add(self, frame: Frame) -> None:
        self.end = _grey(frame.image, _SIDE)
        if not self.indices:
            self.begin = self.end
        still, now = (_shrunk(grey, _STILL_WIDTH).astype(np.int16) for grey in (self.begin, self.end))
        self.change = max(self.change, float(np.percentile(np.abs(now - still), _STILL_PERCENTILE)))
        detail = float(np.abs(cv2.Laplacian(self.end, cv2.CV_32F)).mean())
        self.sharpness = max(self.sharpness, detail / max(float(self.end.std()), 1.0))
        self.indices.append(frame.index)


def read_edit(frames: Iterable[Frame]) -> Edit:
    """Find the shots of footage, and what is beside them.

    A stretch in which nothing moves is a slate, a card or bars if another one moves. A stretch of a few frames beside a
    long one is a piece that an editor has left, or a whip pan. Two stretches with nearly the same view at the cut are
    one shot.
    """
    stretches = by_shot(frames, _Stretch, _Stretch.add)
    longest = max((len(stretch.indices) for stretch in stretches), default=0)
    sharpness = max((stretch.sharpness for stretch in stretches if len(stretch.indices) == longest), default=0.0)
    if longest < _LEAST_FRAMES:  # no shots but single images, or large steps
        return Edit((stretches[0].indices[0],)) if stretches else Edit((0,))
    moving = [stretch for stretch in stretches if stretch.change > _STILL_CHANGE]
    kept, left_out = [], []
    for stretch in stretches:
        if len(stretch.indices) < min(_LEAST_FRAMES, _LEAST_SHARE * longest):
            reason = f"of another view, too few for a shot ({len(stretch.indices)})"
        elif len(stretch.indices) < _LEAST_FRAMES and stretch.sharpness < _BLURRED * sharpness:
            reason = f"blurred by a fast pan, too few for a shot ({len(stretch.indices)})"
        elif moving and stretch not in moving:
            reason = "a picture that stands still (a slate, a card, bars)"
        else:
            kept.append(stretch)
            continue
        left_out.append(LeftOut(stretch.indices[0], stretch.indices[-1], reason))
    return Edit(tuple(shot.start for shot in _joined(kept)), tuple(left_out))


def find_shots(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]], frames: slice | None = None, *, fields: Fields = "auto"
) -> list[range]:
    """The shots of a video, each as the range of its frames; blank frames at either end are left out.

    A step over frames that a recorder has dropped is no cut where both sides show nearly the same view.

    Args:
        source, frames, fields: as in `read_frames`; the ranges count frames of the source.

    Raises:
        InputError: the source cannot be read.
    """
    return _joined(by_shot(read_frames(source, frames, fields=fields), _Stretch, _Stretch.add))


def _joined(stretches: Sequence[_Stretch]) -> list[range]:
    """Stretches as ranges of frames; those with nearly the same view at the cut between them are one."""
    shots: list[range] = []
    for before, stretch in zip([None, *stretches], stretches, strict=False):
        goes_on = before is not None and _is_same_view(before.end, stretch.begin)
        first = shots.pop().start if goes_on else stretch.indices[0]
        shots.append(range(first, stretch.indices[-1] + 1))
    return shots


def _is_same_view(first: Grey, second: Grey) -> bool:
    """Whether two images show nearly the same: many matches of features that moved little, by one similarity."""
    sift, matcher = cv2.SIFT.create(_FEATURES), cv2.BFMatcher()
    (points, features), (others, other_features) = (sift.detectAndCompute(image, None) for image in (first, second))
    if features is None or other_features is None:
        return False
    pairs = [pair for pair in matcher.knnMatch(features, other_features, k=2) if len(pair) == 2]
    matches = [best for best, next_best in pairs if best.distance < _RATIO * next_best.distance]
    if len(matches) < _LEAST_MATCHES:
        return False
    a = np.array([points[match.queryIdx].pt for match in matches], np.float32)
    b = np.array([others[match.trainIdx].pt for match in matches], np.float32)
    similarity, inliers = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=_TOLERANCE_PX)
    if similarity is None or inliers.sum() < max(_LEAST_MATCHES, _LEAST_MATCHED * len(matches)):
        return False
    zoom = float(np.hypot(similarity[0, 0], similarity[1, 0]))
    shift = float(np.median(np.linalg.norm((b - a)[inliers.ravel() > 0], axis=1))) / first.shape[1]
    return shift <= _LARGEST_SHIFT and 1.0 / _LARGEST_ZOOM <= zoom <= _LARGEST_ZOOM


def left_out_of(parts: Sequence[LeftOut], index: int) -> str:
    """Why a frame is left out; empty if it is not."""
    return next((part.reason for part in parts if part.holds(index)), "")


def _grey(image: NDArray[np.uint8], width: int) -> Grey:
    return _shrunk(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8), width)


def _shrunk(grey: Grey, width: int) -> Grey:
    height = max(1, round(width * grey.shape[0] / grey.shape[1]))
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
