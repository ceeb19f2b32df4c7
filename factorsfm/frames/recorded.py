"""How the frames of a shot were recorded: pixels, fields, bars, times, and frames that repeat the one before."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.timing import are_uneven, cadence, frame_interval, frame_times
from factorsfm.support.first_few import first_few
from factorsfm.support.pace import USUAL_RATE
from factorsfm.support.picture_area import PictureArea

_MOST_NOTED = 3  # repeated frames that are named

T = TypeVar("T")


class _Timed(Protocol):
    """A frame with its number and time."""

    @property
    def index(self) -> int: ...
    @property
    def timestamp(self) -> float | None: ...


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """A frame that repeats none; `timestamp`: seconds, None if unknown."""

    index: int
    name: str
    timestamp: float | None


@dataclass(frozen=True, slots=True)
class Repeat:
    """A repeated frame; `twin`: position among the other frames of the one that it repeats."""

    index: int
    name: str
    timestamp: float | None
    twin: int


@dataclass(frozen=True, slots=True)
class RecordedFootage:
    """What the frames of a shot say of their recording.

    Attributes:
        repeats: the frames that repeat others, in order.
        pixel_aspect: width of a pixel over its height; is_field: whether the frames are fields of interlaced video.
        picture: what of the frames is picture, None where they have no bars.
    """

    repeats: list[Repeat]
    pixel_aspect: float = 1.0
    is_field: bool = False
    picture: PictureArea | None = None

    def with_repeats(self, taken: Sequence[T]) -> list[T]:
        """Of all frames in order, from what the frames have that repeat none: repeats have that of their twins."""
        twins = [repeat.twin for repeat in self.repeats]
        return [taken[position] for position in sorted([*range(len(taken)), *twins])]

    def of(self, kept: Sequence[int]) -> RecordedFootage:
        """That of some frames that repeat none (ascending positions), and of their repeats."""
        place = {position: k for k, position in enumerate(kept)}
        repeats = [replace(repeat, twin=place[repeat.twin]) for repeat in self.repeats if repeat.twin in place]
        return replace(self, repeats=repeats)

    def times(self, frames: Sequence[_Timed]) -> NDArray[np.float64]:
        """(n,) when the frames that repeat none were recorded, in usual intervals between two of them.

        Where frames repeat in a cadence, the others were recorded evenly, whatever the times at which they are shown.
        """
        if self._cadence(len(frames)) is not None:
            return np.arange(len(frames), dtype=np.float64)
        return frame_times([frame.index for frame in frames], [frame.timestamp for frame in frames])

    def seconds(self, frames: Sequence[_Timed]) -> NDArray[np.float64]:
        """(n,) the same in seconds, at the usual rate where that is unknown."""
        return self.times(frames) * (self.interval(frames) or 1.0 / USUAL_RATE)

    def interval(self, frames: Sequence[_Timed]) -> float:
        """Seconds in one unit of `times`, 0 if unknown."""
        interval = frame_interval([frame.index for frame in frames], [frame.timestamp for frame in frames])
        rhythm = self._cadence(len(frames))
        return interval if rhythm is None else interval * rhythm[0] / rhythm[1]

    def positions(self, count: int) -> list[int]:
        """Positions among all frames of those that repeat none."""
        twins = np.array([repeat.twin for repeat in self.repeats], np.int64)
        return [position + int((twins < position).sum()) for position in range(count)]

    def _cadence(self, frames: int) -> tuple[int, int] | None:
        if not self.repeats:
            return None
        repeated = np.ones(frames + len(self.repeats), bool)
        repeated[self.positions(frames)] = False
        return cadence(repeated.tolist())

    def notes(self, frames: Sequence[_Timed], camera: pycolmap.Camera) -> list[str]:
        """What there is to say of the recording; `frames`: those that repeat none."""
        notes = []
        if self.is_field:
            notes.append(
                "Interlaced video: its fields were taken apart. Frames 2k and 2k + 1 are the fields of frame k of the "
                "file, each with half of its lines."
            )
        if self.pixel_aspect != 1.0:
            notes.append(
                f"Pixels are {self.pixel_aspect:.4g} times as wide as high: the focal length is "
                f"{camera.focal_length_x:.0f} pixels across and {camera.focal_length_y:.0f} down."
            )
        if self.picture is not None:
            bars = self.picture.said(camera.width, camera.height)
            notes.append(f"Black bars, {bars}, are no part of the picture: nothing is tracked in them.")
        indices, timestamps = [frame.index for frame in frames], [frame.timestamp for frame in frames]
        interval, rhythm = frame_interval(indices, timestamps), self._cadence(len(frames))
        if self.repeats:
            notes.append(f"{self._repeats_said(rhythm, interval)} They have the pose of the frame that they repeat.")
        if rhythm is None and are_uneven(indices, timestamps):
            steps = np.diff(np.array(timestamps, np.float64)) / np.diff(indices)
            notes.append(
                f"Frames come at uneven times, {1e3 * steps.min():.0f} to {1e3 * steps.max():.0f} ms after one "
                "another: exports at a constant rate show each as long as any other."
            )
        back = _jumps_back(frames)
        if back:
            notes.append(
                f"Times of frames do not rise, before frame {first_few(back, _MOST_NOTED)}: all frames count as "
                "recorded evenly. The file may be several recordings, one behind another."
            )
        return notes

    def _repeats_said(self, rhythm: tuple[int, int] | None, interval: float) -> str:
        """Which frames repeat others."""
        if rhythm is None:
            some = first_few([repeat.index for repeat in self.repeats], _MOST_NOTED)
            return f"Frames that repeat the one before, without a cadence: {len(self.repeats)} ({some})."
        period, new = rhythm
        rates = f": {new / interval / period:.4g} in {1 / interval:.4g} frames a second" if interval > 0 else ""
        if new == period - 1:
            return f"Every {_ordinal(period)}frame repeats the one before{rates}."
        return f"Of every {period} frames {period - new} repeat the one before{rates}."


def _jumps_back(frames: Sequence[_Timed]) -> list[int]:
    """Numbers of the frames that are not later than the one before."""
    timed = [(frame.index, frame.timestamp) for frame in frames if frame.timestamp is not None]
    return [index for (_, before), (index, time) in itertools.pairwise(timed) if time <= before]


def _ordinal(number: int) -> str:
    words = {2: "second ", 3: "third ", 4: "fourth ", 5: "fifth ", 6: "sixth "}
    return words.get(number, f"{number}th ")
