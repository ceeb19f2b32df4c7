"""Numbered sequences: file names that differ in nothing but a number."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence

NUMBERED = re.compile(r"(.*?)(\d+)(\.\w+)", re.DOTALL)  # what stands before the last number of a name, it, the suffix
# A number of frames: at 120 frames a second a day has 10 million of them. What is longer is a time or a serial number.
_MOST_DIGITS = 8


def sequence_numbers(names: Sequence[str]) -> list[int] | None:
    """The number in each name if they differ in nothing else, as ``plate.1001.exr``, ``plate.1002.exr``; else None.

    Args:
        names: in natural order.
    """
    found = [NUMBERED.fullmatch(name) for name in names]
    matches = [match for match in found if match is not None]
    if not names or len(matches) != len(names) or len({(match[1], match[3].lower()) for match in matches}) != 1:
        return None
    numbers = [int(match[2]) for match in matches]
    ascending = all(a < b for a, b in itertools.pairwise(numbers))
    return numbers if ascending and len(str(numbers[-1])) <= _MOST_DIGITS else None
