"""A decoded video frame as an image: upright, in 8 bits, with one tone curve for high dynamic range."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import av
import numpy as np
from av.sidedata.sidedata import SideData
from av.video.reformatter import ColorTrc, VideoReformatter
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_PEAK = 1000 / 203  # of what HDR is graded for, over diffuse white, both in cd/m2 (ITU-R BT.2408)


class Picture:
    """Converts the frames of one video.

    Limited or full range and the matrix are those that each frame states, BT.601 where it states none, as in FFmpeg.
    """

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()  # one for all frames keeps swscale's tables

    def bgr(self, frame: av.VideoFrame) -> Image:
        """(h, w, 3) BGR, not turned yet."""
        curve = _tone_curve(int(frame.color_trc))
        if curve is None:
            return np.asarray(self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray(), np.uint8)
        return curve[self._reformatter.reformat(frame, format="bgr48le", threads=1).to_ndarray()]


@lru_cache(2)
def _tone_curve(transfer: int) -> NDArray[np.uint8] | None:
    """(65536,) 8-bit values of a high dynamic range signal of 16 bits; None where the signal is shown as it is.

    PQ and HLG (ITU-R BT.2100) become light over diffuse white, which Reinhard's global operator (Reinhard et al. 2002,
    equation 4) brings into range, and the curve of sRGB encodes. Diffuse white comes to 193 of 255 in both.
    """
    signal = np.linspace(0.0, 1.0, 65536)
    if transfer == ColorTrc.SMPTE2084:
        power = signal ** (32 / 2523)
        light = (np.maximum(power - 0.8359375, 0.0) / (18.8515625 - 18.6875 * power)) ** (16384 / 2610) * 10000 / 203
    elif transfer == ColorTrc.ARIB_STD_B67:
        light = _light_of_hlg(signal) / _light_of_hlg(np.array(0.75))  # BT.2408: diffuse white is 75 % of the signal
    else:
        return None
    shown = np.minimum(light * (1.0 + light / _PEAK**2) / (1.0 + light), 1.0)
    encoded = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * encoded), np.uint8)


def _light_of_hlg(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light of the scene, 1 at the largest signal."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)


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
