"""Ranges of frames: parsed, checked and written."""

from __future__ import annotations

import re

from factorsfm.support.errors import InputError

_RANGE = re.compile(r"(\d{0,18}):(\d{0,18})(?::(\d{1,18}))?", re.ASCII)


def parse_range(text: str) -> slice:
    """Parse ``START:STOP[:STEP]``; frames count from 0, STOP is excluded, START or STOP may be left out.

    Raises:
        InputError: another form, a step of zero, or an empty range.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None or not any(match.groups()):
        raise InputError(f'frame range "{text}" is not START:STOP[:STEP] with whole numbers from 0')
    start, stop, step = (int(part) if part else None for part in match.groups())
    return checked_range(slice(start, stop, step))


def checked_range(frames: slice) -> slice:
    """The same range, with 0 and 1 for a missing START and STEP.

    Raises:
        InputError: it is not a slice, holds a negative number or a step of zero, or is empty.
    """
    if not isinstance(frames, slice):
        raise InputError(f"frames is {frames!r}; a slice is expected, such as slice(0, 100, 2)")
    start, stop, step = frames.start or 0, frames.stop, 1 if frames.step is None else frames.step
    text = range_text(frames)
    if start < 0 or (stop is not None and stop < 0) or step < 0:
        raise InputError(f"frame range {text} holds a negative number; frames count from 0")
    if step == 0:
        raise InputError(f"frame range {text} has step 0; the step must be at least 1")
    if stop is not None and stop <= start:
        raise InputError(f"frame range {text} is empty; STOP must be larger than START")
    return slice(start, stop, step)


def range_text(frames: slice) -> str:
    """The range in the form that `parse_range` reads."""
    start, stop = ("" if part is None else str(part) for part in (frames.start, frames.stop))
    return f"{start}:{stop}" + ("" if frames.step is None else f":{frames.step}")


def in_range(number: int, frames: slice) -> bool:
    """Whether a frame with this number is in a checked range."""
    start, stop, step = frames.start, frames.stop, frames.step
    return bool(start <= number and (stop is None or number < stop) and (number - start) % step == 0)
