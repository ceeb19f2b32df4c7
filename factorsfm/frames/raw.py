"""Raw frames without a container, from a pipe or a binary file."""

from __future__ import annotations

import itertools
import re
import select
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.support.errors import InputError

_POLL_SECONDS = 0.1  # between two tests whether the frames of a silent pipe are still wanted

_BYTES_PER_PIXEL = {"bgr24": 3.0, "rgb24": 3.0, "gray8": 1.0, "yuv420p": 1.5, "nv12": 1.5}
_YUV = {"yuv420p": cv2.COLOR_YUV2BGR_I420, "nv12": cv2.COLOR_YUV2BGR_NV12}


@dataclass(frozen=True, slots=True)
class RawFormat:
    """Size and pixel format of raw frames.

    Attributes:
        width, height: pixels; even for yuv420p and nv12.
        pixels: bgr24, rgb24, gray8, yuv420p (also known as I420) or nv12, as FFmpeg names them.

    Raises:
        InputError: there is no such format.
    """

    width: int
    height: int
    pixels: str = "bgr24"

    def __post_init__(self) -> None:
        if self.pixels not in _BYTES_PER_PIXEL:
            raise InputError(f'pixel format "{self.pixels}" is not one of {", ".join(_BYTES_PER_PIXEL)}')
        if self.width < 1 or self.height < 1:
            raise InputError(f"raw frames of {self.width}x{self.height} pixels hold nothing")
        if self.pixels in _YUV and (self.width % 2 or self.height % 2):
            raise InputError(f"raw frames of {self.width}x{self.height} pixels: {self.pixels} needs even numbers")

    @classmethod
    def parse(cls, text: str) -> RawFormat:
        """From ``WIDTHxHEIGHT:PIXELS``, for example ``960x540:yuv420p``.

        Raises:
            InputError: another form, or there is no such format.
        """
        match = re.fullmatch(r"(\d{1,6})x(\d{1,6}):(\w+)", text.strip(), re.ASCII)
        if match is None:
            raise InputError(f'raw format "{text}" is not WIDTHxHEIGHT:PIXELS, for example 960x540:bgr24')
        return cls(int(match[1]), int(match[2]), match[3])

    @property
    def frame_bytes(self) -> int:
        """Size of one frame, bytes."""
        return int(self.width * self.height * _BYTES_PER_PIXEL[self.pixels])

    def image(self, data: bytes | bytearray) -> NDArray[np.uint8]:
        """(height, width, 3) BGR from the bytes of one frame."""
        values = np.frombuffer(data, np.uint8)
        if self.pixels in _YUV:
            planes = values.reshape(self.height * 3 // 2, self.width)
            return np.asarray(cv2.cvtColor(planes, _YUV[self.pixels]), np.uint8)
        image = values.reshape(self.height, self.width, -1)
        return bgr_image(image[:, :, ::-1] if self.pixels == "rgb24" else image, 0)


def raw_frames(file: BinaryIO, raw: RawFormat, name: str, closed: threading.Event) -> Iterator[Frame]:
    """The frames of a binary file or pipe.

    Args:
        name: of the source, for the error message.
        closed: set by another thread when no further frames are wanted.

    Raises:
        InputError: the file ends inside a frame.
    """
    for index in itertools.count():
        data = _read(file, raw.frame_bytes, closed)
        if not data or closed.is_set():
            return
        if len(data) < raw.frame_bytes:
            raise InputError(f"{name} ended inside frame {index}: {len(data)} of {raw.frame_bytes} bytes")
        yield Frame(index, raw.image(data), f"{index:06d}")


def _read(file: BinaryIO, size: int, closed: threading.Event) -> bytearray:
    """Read `size` bytes; fewer at the end of the file, or when the source is closed meanwhile."""
    read_some = getattr(file, "read1", file.read)  # what a pipe holds now, without waiting for the rest
    data = bytearray()
    while len(data) < size and not closed.is_set():
        if _is_readable(file):
            part = read_some(size - len(data))
            if not part:
                break
            data += part
    return data


def _is_readable(file: BinaryIO) -> bool:
    """Whether reading returns at once, after a short wait; True where that cannot be known, so that it may block."""
    try:
        return bool(select.select([file], [], [], _POLL_SECONDS)[0])
    except (OSError, ValueError, TypeError):  # no file descriptor, or one that `select` does not take
        return True
