"""Images named by the time at which they were recorded, as data sets of robots name theirs."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

# 1305031102.175304.png in seconds, 1403636579763555584.png in nanoseconds: one number, with or without a point.
_NAME = re.compile(r"(?P<prefix>\D*)(?P<whole>\d+)(\.(?P<part>\d+))?(?P<suffix>\D*)", re.DOTALL)
_UNIX_DIGITS = 10  # of the seconds since 1970, from 2001 to 2286 ...
_PARTS_OF_SECOND = (3, 6, 9)  # ... and more digits for milli-, micro- and nanoseconds
_LEAST_DECIMALS = 6  # of seconds that begin with the recording
_LEAST_STEP_SECONDS = 1e-3  # usual one; numbers that count on from 1.000001 have smaller ones


def times_in(names: Sequence[str]) -> list[float] | None:
    """The times in the names of images, seconds; None where they are no times.

    These are seconds since 1970 with decimals, or without a point in parts of a second; or seconds since any other
    time with six decimals or more, which a single name does not tell from a number. What stands around the times is
    the same in all names. They may be in any order.
    """
    found = [_NAME.fullmatch(name) for name in names]
    matches = [match for match in found if match is not None]
    if not names or len(matches) < len(names):
        return None
    if len({(match["prefix"], match["suffix"].lower()) for match in matches}) > 1:
        return None
    seconds = [_seconds(match["whole"], match["part"]) for match in matches]
    times = [time for time, _ in seconds if time is not None]
    if len(times) < len(names) or (len(names) == 1 and not seconds[0][1]):
        return None
    steps = np.diff(np.sort(times))
    return times if not len(steps) or float(np.median(steps)) >= _LEAST_STEP_SECONDS else None


def _seconds(whole: str, part: str | None) -> tuple[float | None, bool]:
    """The time in a name, None if it is none, and whether it is one since 1970."""
    since_1970 = not whole.startswith("0") and len(whole) >= _UNIX_DIGITS
    if part is not None:
        is_time = len(whole) == _UNIX_DIGITS if since_1970 else len(part) >= _LEAST_DECIMALS
        return (float(f"{whole}.{part}") if is_time else None), since_1970
    if since_1970 and len(whole) - _UNIX_DIGITS in _PARTS_OF_SECOND:
        return float(f"{whole[:_UNIX_DIGITS]}.{whole[_UNIX_DIGITS:]}"), True
    return None, False
