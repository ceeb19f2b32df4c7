"""What the frames of a stream say of their recording; a frame that repeats the one before is not tracked."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import fitted_camera
from factorsfm.camera.guess import guess_camera
from factorsfm.frames.bars import BarDetector
from factorsfm.frames.frame import Frame
from factorsfm.frames.recorded import RecordedFootage, Repeat
from factorsfm.frames.repeats import RepeatDetector
from factorsfm.frames.timing import Pace
from factorsfm.streaming.frame_update import FrameUpdate, repeated_update
from factorsfm.support.picture_area import PictureArea


class Footage:
    """What the frames of a stream say of their recording.

    Attributes:
        repeats: the frames that repeat others, in order.
        pace: how fast the frames come.
    """

    def __init__(self) -> None:
        self.repeats: list[Repeat] = []
        self.pace = Pace()
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
        self.pace.push(frame.index, frame.timestamp)
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

    @property
    def recorded(self) -> RecordedFootage:
        """What the frames so far say of their recording."""
        return RecordedFootage(list(self.repeats), self._pixel_aspect, self._is_field, self._picture)

    def state(self) -> dict[str, Any]:
        """Plain data for `restore`."""
        return {
            "repeats": [astuple(repeat) for repeat in self.repeats],
            "pixels": (self._pixel_aspect, self._is_field),
            "bars": self._bars.state(),
            "pace": self.pace.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state; the next frame counts as new."""
        self.repeats = [Repeat(*repeat) for repeat in state["repeats"]]
        self._pixel_aspect, self._is_field = state["pixels"]
        self._bars.restore(state["bars"])
        self.pace = Pace(state["pace"])


def _grey(frame: Frame) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8)
