"""The tone curves: from the numbers of an image or video file to the 8 bits that are tracked.

Two kinds of footage hold more light than 8 bits do. Linear light of a camera has no largest value, and its curve is
logarithmic. A graded signal of high dynamic range has a peak that it was graded for, and its curve gives the picture of
an ordinary display, as networks know it. Tracking does not care: with either curve for either kind the paths of
rendered shots with noise agree within a tenth of their errors.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

# The curve for linear light. Twice as much light is the same number of grey levels everywhere, since the contrast of a
# surface is a ratio that exposure does not change; below four stops under middle grey the curve bends to a line, where
# noise drowns what there is. Seven stops above middle grey are white, as far as film and cinema cameras record. That
# makes 23 grey levels a stop, as the 90 of 1,023 codes a stop do of a film scan in DPX (Cineon's printing density).
_MIDDLE_GREY = 0.18
_STOPS_BELOW, _STOPS_ABOVE = 4, 7

_PEAK = 1000 / 203  # of what HDR is graded for, over diffuse white, both in cd/m2 (ITU-R BT.2408)
_PQ, _HLG = 16, 18  # transfer characteristics of ITU-T H.273, as FFmpeg reports them


def tone_curve(light: NDArray[np.floating]) -> NDArray[np.float64]:
    """Brightness from 0 to 1 of linear light: ``log2(1 + 16 x / 0.18) / log2(1 + 2048)``, cut at both ends.

    Negative light and NaN are black. The same curve for every frame, so that brightness does not flicker.
    """
    x = np.nan_to_num(np.asarray(light, np.float64), nan=0.0, posinf=np.inf, neginf=0.0)
    white = 2.0 ** (_STOPS_BELOW + _STOPS_ABOVE)
    curve = np.log2(1.0 + np.clip(2.0**_STOPS_BELOW / _MIDDLE_GREY * x, 0.0, white)) / np.log2(1.0 + white)
    return np.asarray(curve, np.float64)


def eight_bits(pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
    """What is tracked of an image: uint8 as it is, uint16 rounded, half and float through the `tone_curve`.

    Integers are taken as they are, for display or in a logarithmic encoding; floating-point numbers are linear light.
    """
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, np.uint8)
    if pixels.dtype == np.uint16:
        return np.asarray(_rounded_table()[pixels], np.uint8)
    with np.errstate(over="ignore"):  # beyond the range of half is beyond white
        half = pixels.astype(np.float16, copy=False)
    return np.asarray(_half_table()[half.view(np.uint16)], np.uint8)


@lru_cache(1)
def _rounded_table() -> NDArray[np.uint8]:
    return np.round(np.arange(65536) / 257).astype(np.uint8)


@lru_cache(1)
def _half_table() -> NDArray[np.uint8]:
    """The curve at all numbers of half precision, by their bits."""
    return np.round(255 * tone_curve(np.arange(65536, dtype=np.uint16).view(np.float16))).astype(np.uint8)


@lru_cache(2)
def eight_bits_of_hdr(transfer: int) -> NDArray[np.uint8] | None:
    """(65536,) 8-bit values of a high dynamic range signal of 16 bits; None where the signal is shown as it is.

    PQ and HLG (ITU-R BT.2100) become light over diffuse white, which Reinhard's global operator (Reinhard et al. 2002,
    equation 4) brings into range, and the curve of sRGB encodes. Diffuse white comes to 193 of 255 in both.
    """
    signal = np.linspace(0.0, 1.0, 65536)
    if transfer == _PQ:
        power = signal ** (32 / 2523)
        light = (np.maximum(power - 0.8359375, 0.0) / (18.8515625 - 18.6875 * power)) ** (16384 / 2610) * 10000 / 203
    elif transfer == _HLG:
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
