"""Images named by the time at which they were recorded, as data sets of robots name theirs."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

# 1305031102.175304.png in seconds, 1305031102-175304000.png in seconds and nanoseconds, 1403636579763555584.png in
# nanoseconds: one number, or two.
_NAME = re.compile(r"(?P<prefix>\D*)(?P<whole>\d+)((?P<point>[._-])(?P<part>\d+))?(?P<suffix>\D*)", re.DOTALL)
_UNIX_DIGITS = 10  # of the seconds since 1970, from 2001 to 2286 ...
_PARTS_OF_SECOND = (3, 6, 9)  # ... and more digits for milli-, micro- and nanoseconds
_DECIMALS, _FEW_DECIMALS = 6, 3  # of seconds that begin with the recording
_LEAST_STEP_SECONDS = 2e-3  # usual one; numbers that count on from 1.001 have smaller ones


def times_in(names: Sequence[str]) -> list[float] | None:
    """The times in the names of images, seconds; None where they are no times.

    These are seconds since 1970 with decimals, or without a point in parts of a second; or seconds since any other
    time, which a single name does not tell from a number. What stands around the times is the same in all names. They
    may be in any order.
    """
    found = [_NAME.fullmatch(name) for name in names]
    matches = [match for match in found if match is not None]
    if not names or len(matches) < len(names):
        return None
    if len({(match["prefix"], match["point"], match["suffix"].lower()) for match in matches}) > 1:
        return None
    times = _since_1970(matches) or _since_the_beginning(matches)
    if times is None:
        return None
    steps = np.diff(np.sort(times))
    return times if not len(steps) or float(np.median(steps)) >= _LEAST_STEP_SECONDS else None


def _since_1970(matches: Sequence[re.Match[str]]) -> list[float] | None:
    times = []
    for match in matches:
        whole, part = match["whole"], match["part"] or ""
        more = len(whole) - _UNIX_DIGITS
        is_time = not whole.startswith("0") and (
            more == 0 and (match["point"] == "." or len(part) == max(_PARTS_OF_SECOND))
            if part
            else more in _PARTS_OF_SECOND
        )
        if not is_time:
            return None
        times.append(float(f"{whole[:_UNIX_DIGITS]}.{whole[_UNIX_DIGITS:]}{part}"))
    return times


def _since_the_beginning(matches: Sequence[re.Match[str]]) -> list[float] | None:
    """Decimals, which are no numbers of frames: very many, or filled up on the right, or over several seconds."""
    if len(matches) < 2 or matches[0]["point"] != ".":
        return None
    parts, wholes = [match["part"] for match in matches], [match["whole"] for match in matches]
    if any(whole.startswith("0") and len(whole) > 1 for whole in wholes):
        return None
    uneven = len({len(part) for part in parts}) > 1
    are_decimals = (
        max(map(len, parts)) >= _DECIMALS
        or (uneven and any(part.startswith("0") and len(part) > 1 for part in parts))
        or (not uneven and len(parts[0]) >= _FEW_DECIMALS and len(set(wholes)) > 1)
    )
    return [float(f"{whole}.{part}") for whole, part in zip(wholes, parts, strict=True)] if are_decimals else None
