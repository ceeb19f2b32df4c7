"""How the frames of a stream were recorded: pixels, fields, bars, times, and frames that repeat the one before.

A repeated frame is no evidence: it is not tracked. It gets the pose of the frame that it repeats, its twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import fitted_camera
from factorsfm.camera.guess import guess_camera
from factorsfm.frames.bars import BarDetector
from factorsfm.frames.frame import Frame
from factorsfm.frames.repeats import RepeatDetector
from factorsfm.frames.timing import are_uneven, cadence, frame_interval, frame_times
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.frame_update import FrameUpdate, SeenFrame, repeated_update
from factorsfm.support.picture_area import PictureArea

_MOST_NOTED = 3  # repeated frames that are named

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Repeat:
    """A repeated frame; `twin`: position among the other frames of the one that it repeats."""

    index: int
    name: str
    timestamp: float | None
    twin: int


class Footage:
    """What the frames of a stream say of their recording.

    Attributes:
        repeats: the frames that repeat others, in order.
    """

    def __init__(self) -> None:
        self.repeats: list[Repeat] = []
        self._pixel_aspect, self._is_field = 1.0, False
        self._detector = RepeatDetector()
        self._bars = BarDetector()
        self._picture: PictureArea | None = None
        self._shape: tuple[int, ...] = (0, 0)
        self._last: FrameUpdate | None = None

    def opened(self, frame: Frame, camera: pycolmap.Camera | None) -> pycolmap.Camera:
        """The camera for the first frame and all that follow: the one given, else a guess.

        Raises:
            InputError: the camera has another size than the frame.
        """
        height, width = frame.image.shape[:2]
        self._pixel_aspect, self._is_field = frame.pixel_aspect, frame.is_field
        if camera is None:
            picture = BarDetector().push(_grey(frame))
            return guess_camera(width, height, frame.path, frame.pixel_aspect, picture)
        return fitted_camera(camera, width, height, frame.pixel_aspect)

    def seen(self, frame: Frame) -> tuple[Frame, NDArray[np.uint8]]:
        """The next frame with what of it is picture, and its grey image, (h, w)."""
        grey = _grey(frame)
        self._picture, self._shape = self._bars.push(grey), grey.shape
        return replace(frame, picture=self._picture), grey

    def ignored(self, mask: NDArray[np.bool_] | None, border_px: int) -> NDArray[np.bool_] | None:
        """The mask of the newest frame with its bars, to which tracks keep their distance as to the border."""
        if self._picture is None:
            return mask
        bars = self._picture.outside(self._shape, border_px)
        return bars if mask is None else mask | bars

    def repeated(self, frame: Frame, grey: NDArray[np.uint8], taken: int) -> FrameUpdate | None:
        """What is known of a frame that repeats the last one, which is kept here; None of one that does not.

        Args:
            taken: how many frames the stream has taken that repeat none.
        """
        if not self._detector.push(grey) or self._last is None:
            return None
        self.repeats.append(Repeat(frame.index, frame.name, frame.timestamp, taken - 1))
        return repeated_update(frame, self._last)

    def told(self, update: FrameUpdate) -> FrameUpdate:
        """Remember what was said of the newest frame that repeats none; the same update."""
        self._last = update
        return update

    def with_repeats(self, taken: Sequence[T]) -> list[T]:
        """Of all frames in order, from what the frames have that repeat none: repeats have that of their twins."""
        twins = [repeat.twin for repeat in self.repeats]
        return [taken[position] for position in sorted([*range(len(taken)), *twins])]

    def times(self, frames: Sequence[SeenFrame]) -> NDArray[np.float64]:
        """(n,) when the frames that repeat none were recorded, in usual intervals between two of them.

        Where frames repeat in a cadence, the others were recorded evenly, whatever the times at which they are shown.
        """
        if self._cadence(frames) is not None:
            return np.arange(len(frames), dtype=np.float64)
        return frame_times([frame.index for frame in frames], [frame.timestamp for frame in frames])

    def interval(self, frames: Sequence[SeenFrame]) -> float:
        """Seconds in one unit of `times`, 0 if unknown."""
        interval = frame_interval([frame.index for frame in frames], [frame.timestamp for frame in frames])
        rhythm = self._cadence(frames)
        return interval if rhythm is None else interval * rhythm[0] / rhythm[1]

    def add_to(self, result: Reconstruction) -> None:
        """Give the repeated frames their results, and say what there is to say of the recording."""
        notes = self._notes(result.frames, result.camera)
        position = np.array(self._positions(len(result.frames)), np.int64)
        result.frames = self.add_results(result.frames)
        result.observation_frame = position[result.observation_frame]
        result.notes += notes

    def add_results(self, frames: Sequence[FrameResult]) -> list[FrameResult]:
        """The results of all frames, from those of the frames that repeat none."""
        found = list(frames)
        for repeat in reversed(self.repeats):
            twin = frames[repeat.twin]
            found.insert(repeat.twin + 1, _like_twin(twin, repeat))
        return found

    def state(self) -> dict[str, Any]:
        """Plain data for `restore`."""
        return {
            "repeats": [astuple(repeat) for repeat in self.repeats],
            "pixels": (self._pixel_aspect, self._is_field),
            "bars": self._bars.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state; the next frame counts as new."""
        self.repeats = [Repeat(*repeat) for repeat in state["repeats"]]
        self._pixel_aspect, self._is_field = state["pixels"]
        self._bars.restore(state["bars"])

    def _positions(self, count: int) -> list[int]:
        """Positions among all frames of those that repeat none."""
        twins = np.array([repeat.twin for repeat in self.repeats], np.int64)
        return [position + int((twins < position).sum()) for position in range(count)]

    def _cadence(self, frames: Sequence[SeenFrame] | Sequence[FrameResult]) -> tuple[int, int] | None:
        if not self.repeats:
            return None
        repeated = np.ones(len(frames) + len(self.repeats), bool)
        repeated[self._positions(len(frames))] = False
        return cadence(repeated.tolist())

    def _notes(self, frames: Sequence[FrameResult], camera: pycolmap.Camera) -> list[str]:
        notes = []
        if self._is_field:
            notes.append(
                "Interlaced video: its fields were taken apart. Frames 2k and 2k + 1 are the fields of frame k of the "
                "file, each with half of its lines."
            )
        if self._pixel_aspect != 1.0:
            notes.append(
                f"Pixels are {self._pixel_aspect:.4g} times as wide as high: the focal length is "
                f"{camera.focal_length_x:.0f} pixels across and {camera.focal_length_y:.0f} down."
            )
        if self._picture is not None:
            bars = self._picture.said(camera.width, camera.height)
            notes.append(f"Black bars, {bars}, are no part of the picture: nothing is tracked in them.")
        indices, timestamps = [frame.index for frame in frames], [frame.timestamp for frame in frames]
        interval, rhythm = frame_interval(indices, timestamps), self._cadence(frames)
        if self.repeats:
            notes.append(f"{self._repeats_said(rhythm, interval)} They have the pose of the frame that they repeat.")
        if rhythm is None and are_uneven(indices, timestamps):
            steps = np.diff(np.array(timestamps, np.float64)) / np.diff(indices)
            notes.append(
                f"Frames come at uneven times, {1e3 * steps.min():.0f} to {1e3 * steps.max():.0f} ms after one "
                "another: exports at a constant rate show each as long as any other."
            )
        return notes

    def _repeats_said(self, rhythm: tuple[int, int] | None, interval: float) -> str:
        """Which frames repeat others."""
        if rhythm is None:
            some = ", ".join(str(repeat.index) for repeat in self.repeats[:_MOST_NOTED])
            more = ", …" if len(self.repeats) > _MOST_NOTED else ""
            return f"Frames that repeat the one before, without a cadence: {len(self.repeats)} ({some}{more})."
        period, new = rhythm
        rates = f": {new / interval / period:.4g} in {1 / interval:.4g} frames a second" if interval > 0 else ""
        if new == period - 1:
            return f"Every {_ordinal(period)}frame repeats the one before{rates}."
        return f"Of every {period} frames {period - new} repeat the one before{rates}."


def _grey(frame: Frame) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8)


def _ordinal(number: int) -> str:
    words = {2: "second ", 3: "third ", 4: "fourth ", 5: "fifth ", 6: "sixth "}
    return words.get(number, f"{number}th ")


def _like_twin(twin: FrameResult, repeat: Repeat) -> FrameResult:
    """The result of a repeated frame: that of its twin, without what a frame adds to it."""
    return replace(
        twin,
        index=repeat.index,
        name=repeat.name,
        timestamp=repeat.timestamp,
        message=f"repeats frame {twin.index}: {twin.message}",
        repeats=twin.index,
        keyframe=False,
        relative_covariance=None,
    )
