"""The tone curve: from the numbers of an image file to the 8 bits that are tracked."""

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
