"""A decoded video frame as an image: upright, in 8 bits, with one tone curve for high dynamic range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import av
import numpy as np
from av.sidedata.sidedata import SideData
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from factorsfm.frames.tone import eight_bits_of_hdr

Image = NDArray[np.uint8]


class Picture:
    """Converts the frames of one video.

    Limited or full range and the matrix are those that each frame states, BT.601 where it states none, as in FFmpeg.
    """

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()  # one for all frames keeps swscale's tables

    def bgr(self, frame: av.VideoFrame) -> Image:
        """(h, w, 3) BGR, not turned yet."""
        curve = eight_bits_of_hdr(int(frame.color_trc))
        if curve is None:
            return np.asarray(self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray(), np.uint8)
        return curve[self._reformatter.reformat(frame, format="bgr48le", threads=1).to_ndarray()]


@dataclass(frozen=True, slots=True)
class Orientation:
    """How the stored image is turned and mirrored to be shown upright.

    Attributes:
        turned: whether rows and columns change places.
        across, down: 1, or -1 where the shown image runs against the stored one along its columns or rows.
    """

    turned: bool = False
    across: int = 1
    down: int = 1

    @classmethod
    def of(cls, frame: av.VideoFrame) -> Orientation:
        """That of a frame, from the container's display matrix."""
        data = frame.side_data.get("DISPLAYMATRIX")
        if data is None:
            return cls()
        a, b, _, c, d, *_ = np.frombuffer(
            bytes(cast(SideData, data)), np.int32
        ).tolist()  # shown x: a x + c y, shown y: b x + d y
        turned = abs(b) > abs(a)
        across, down = (c, b) if turned else (a, d)
        return cls(turned, -1 if across < 0 else 1, -1 if down < 0 else 1)

    def applied(self, image: Image) -> Image:
        """The image as it is to be shown."""
        turned = image.transpose(1, 0, 2) if self.turned else image
        return np.ascontiguousarray(turned[:: self.down, :: self.across])
