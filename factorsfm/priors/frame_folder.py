"""A folder with a file for each frame: finding the file by name or number, checking its aspect ratio."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.folders import IMAGE_SUFFIXES
from factorsfm.frames.frame import Frame
from factorsfm.frames.name_times import times_in
from factorsfm.frames.sequences import last_number
from factorsfm.support.errors import InputError

_ASPECT_TOLERANCE = 0.02  # relative


class FrameFolder:
    """A folder whose files belong to frames; a frame may lack one.

    A file belongs to the frame whose name it bears ("a.npy" or "a.jpg.npy" for "a.jpg"), otherwise to the frame with
    its number: the last number in the frame's name that is no version, or the frame's index if the name has none. Files
    that are named by times belong to frames with times: to each the nearest, within half of their usual step.

    Args:
        path: the folder.
        suffixes: those of the files; only files with the first one that occurs in the folder count.
        what: the files in words, for error messages.

    Attributes:
        name: name of the folder.
        suffix: that of the files.
        asked, matched: number of frames whose file was asked for, and of those among them that have one.

    Raises:
        InputError: the folder does not exist, or holds no such file.
    """

    def __init__(self, path: Path, suffixes: Sequence[str], what: str) -> None:
        if not path.is_dir():
            raise InputError(f"there is no folder {path} of {what}")
        files = sorted(file for file in path.iterdir() if file.is_file() and not file.name.startswith("."))
        present = {file.suffix.lower() for file in files}
        suffix = next((suffix for suffix in suffixes if suffix in present), None)
        if suffix is None:
            raise InputError(f"the folder {path} holds no {what} ({', '.join(suffixes)})")
        files = [file for file in files if file.suffix.lower() == suffix]
        self.name = path.name
        self.suffix = suffix
        self.asked = self.matched = 0
        self._first = files[0]
        self._by_name = {file.stem: file for file in files}
        times = times_in([image_stem(file.stem) for file in files])
        self._by_time = sorted(zip(times, files, strict=True)) if times is not None else []
        by_number: dict[int, list[Path]] = {}
        for file in files:
            stem = image_stem(file.stem)
            self._by_name.setdefault(stem, file)
            if (number := last_number(stem)) is not None:
                by_number.setdefault(number, []).append(file)
        self._by_number = {number: same[0] for number, same in by_number.items() if len(same) == 1}

    def has(self, index: int) -> bool:
        """Whether the folder has a file for this frame of a video."""
        return self._find(Frame(index, np.empty((0, 0, 3), np.uint8), f"{index:06d}")) is not None

    def file_of(self, frame: Frame) -> Path | None:
        """The frame's file, None if it has none; counts in `asked` and `matched`."""
        path = self._find(frame)
        self.asked += 1
        self.matched += path is not None
        return path

    def _find(self, frame: Frame) -> Path | None:
        stem = image_stem(frame.name)
        for name in (frame.name, stem):
            if name in self._by_name:
                return self._by_name[name]
        if self._by_time:
            return None if frame.timestamp is None else self._nearest(frame.timestamp)
        number = last_number(stem)
        return self._by_number.get(frame.index if number is None else number)

    def _nearest(self, seconds: float) -> Path | None:
        """The file whose time is nearest, within half of the usual step."""
        times = np.array([time for time, _ in self._by_time])
        k = int(np.abs(times - seconds).argmin())
        reach = float(np.median(np.diff(times))) / 2 if len(times) > 1 else 0.0
        return self._by_time[k][1] if abs(times[k] - seconds) <= reach else None


def image_stem(name: str) -> str:
    """File name without the suffix of an image format: "a.0001.png" becomes "a.0001", which stays as it is."""
    return Path(name).stem if Path(name).suffix.lower() in IMAGE_SUFFIXES else name


def check_aspect(array: NDArray[Any], frame: Frame, path: Path) -> None:
    """Check that a map (h, w, ...) has the aspect ratio of its frame, within 2 %.

    Raises:
        InputError: it has another one.
    """
    (height, width), (frame_height, frame_width) = array.shape[:2], frame.image.shape[:2]
    if abs(width * frame_height / (height * frame_width) - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(
            f"{path} is {width}x{height} and its frame {frame_width}x{frame_height}: the aspect ratios must agree"
        )
