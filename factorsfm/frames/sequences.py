"""Numbered sequences: file names that differ in nothing but a number."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

from factorsfm.frames.name_times import times_in

_DIGITS = re.compile(r"(\d+)")
_VERSION = re.compile(r"(.*[^A-Za-z])?[vV]#{1,3}", re.DOTALL)  # plate_v## of plate_v02; v0001 is rather a frame
_MINUS = re.compile(r"(.*[._])?-", re.DOTALL)  # before a negative number; the hyphen of shot-0001 joins two words
# A number of frames: at 120 frames a second a day has 10 million of them. What is longer is a time or a serial number.
_MOST_DIGITS = 8
_GAPS = 4  # most numbers from the first to the last for each file of a sequence; those of times lie farther apart
LONG = 8  # files of a sequence beside which any other file is a stray one


@dataclass(frozen=True, slots=True)
class NumberedName:
    """A file name around its number: prefix + digits + suffix."""

    prefix: str
    digits: str
    suffix: str

    @property
    def number(self) -> int:
        return int(self.digits)

    @property
    def pattern(self) -> str:
        """The name with # for each digit; alike for all names of a sequence, but for their length."""
        return f"{self.prefix}{'#' * len(self.digits)}{self.suffix}"

    @property
    def is_version(self) -> bool:
        return _VERSION.fullmatch(f"{self.prefix}{'#' * len(self.digits)}") is not None

    @property
    def others(self) -> tuple[str, str]:
        """What the names of a sequence have in common."""
        extension = PurePath(self.suffix).suffix or self.suffix
        return self.prefix, self.suffix.removesuffix(extension) + extension.lower()


def numbered_names(names: Sequence[str]) -> list[NumberedName] | None:
    """The names around the one number in which they differ; None if they differ in more.

    In a single name it is the last number that is no version, as in ``plate_1001_v02.exr``.
    """
    choices = [_around_numbers(name) for name in names]
    if not choices or not choices[0] or {len(found) for found in choices} != {len(choices[0])}:
        return None
    if len(choices) == 1:
        return [_last_number(choices[0])]
    found = [list(column) for column in zip(*choices, strict=True) if len({name.others for name in column}) == 1]
    return found[0] if len(found) == 1 else None


def sequence_numbers(names: Sequence[str]) -> list[int] | None:
    """The number in each name if they differ in nothing else, as ``plate.1001.exr``, ``plate.1002.exr``; else None.

    Times are no numbers of frames.

    Args:
        names: in natural order.
    """
    found = numbered_names(names)
    if found is None or times_in(names) is not None:
        return None
    numbers = [name.number for name in found]
    ascending = all(a < b for a, b in itertools.pairwise(numbers))
    return numbers if ascending and len(str(numbers[-1])) <= _MOST_DIGITS else None


def is_ordered(names: Sequence[str]) -> bool:
    """Whether the names say their order: by numbers or times, in which alone they differ."""
    return sequence_numbers(names) is not None or times_in(names) is not None


def begin_with_numbers(names: Sequence[str]) -> bool:
    """Whether names differ in several numbers alone, and the first of these is another one in each.

    As in ``frame_0007_1305031102.175304.png``.
    """
    parts = [_DIGITS.split(name) for name in names]
    if len({tuple(part[::2]) for part in parts}) != 1:
        return False
    columns = [{int(part) for part in column} for column in list(zip(*parts, strict=True))[1::2]]
    return next((len(column) == len(names) for column in columns if len(column) > 1), False)


def last_number(name: str) -> int | None:
    """The last number of a name that is no version, if it has another one; None for a name without numbers."""
    found = _around_numbers(name)
    return _last_number(found).number if found else None


def is_negative(name: str) -> bool:
    """Whether the last number of a name has a minus, as in ``plate.-0024.png``."""
    found = _around_numbers(name)
    return bool(found) and _MINUS.fullmatch(_last_number(found).prefix) is not None


def split_sequences(names: Sequence[str]) -> tuple[list[list[NumberedName]], list[str]]:
    """The sequences among the names of a folder, longest first, and the names that belong to none.

    Sequences differ in what stands around the number, or, where numbers occur twice, in their padding.
    """
    choices = [_around_numbers(name) for name in names]
    alike = Counter(name.others for found in choices for name in found)
    groups: dict[tuple[str, str], list[NumberedName]] = {}
    strays = [name for name, found in zip(names, choices, strict=True) if not found]
    for found in filter(None, choices):
        most = max(alike[name.others] for name in found)
        chosen = _last_number([name for name in found if alike[name.others] == most])
        groups.setdefault(chosen.others, []).append(chosen)
    sequences = []
    for group in itertools.chain.from_iterable(map(_by_padding, groups.values())):
        if _is_dense(group):
            sequences.append(group)
        else:
            strays += [f"{name.prefix}{name.digits}{name.suffix}" for name in group]
    return sorted(sequences, key=len, reverse=True), strays


def mixture(names: Sequence[str]) -> str:
    """What makes the names of a folder more than one sequence, in words; empty where nothing does."""
    if times_in(names) is not None:
        return ""
    sequences, strays = split_sequences(names)
    if len(sequences) > 1:
        patterns = sorted(sequence[0].pattern for sequence in sequences)
        return f"{len(sequences)} sequences ({', '.join(patterns[:3])}{', ...' if len(patterns) > 3 else ''})"
    if sequences and strays and len(sequences[0]) >= max(LONG, len(strays)):
        more = f" and {len(strays) - 1} more files" if len(strays) > 1 else ""
        return f"{strays[0]}{more} beside the sequence {sequences[0][0].pattern}"
    return ""


def _around_numbers(name: str) -> list[NumberedName]:
    """The name around each of its numbers."""
    parts = _DIGITS.split(name)
    return [NumberedName("".join(parts[:k]), parts[k], "".join(parts[k + 1 :])) for k in range(1, len(parts), 2)]


def _last_number(found: Sequence[NumberedName]) -> NumberedName:
    return ([name for name in found if not name.is_version] or [*found])[-1]


def _by_padding(group: list[NumberedName]) -> list[list[NumberedName]]:
    """The same names, apart by their padding and by upper and lower case if numbers occur twice."""
    if len({name.number for name in group}) == len(group):
        return [group]
    widest = max(len(name.digits) for name in group)
    apart: dict[tuple[bool, str], list[NumberedName]] = {}
    for name in group:
        apart.setdefault((len(name.digits) == widest, name.suffix), []).append(name)
    return list(apart.values())


def _is_dense(group: Sequence[NumberedName]) -> bool:
    """Whether these are numbers of frames, as they follow on each other."""
    numbers = sorted(name.number for name in group)
    span = numbers[-1] - numbers[0] + 1
    return len(group) > 1 and span <= _GAPS * len(group) and len(str(numbers[-1])) <= _MOST_DIGITS
