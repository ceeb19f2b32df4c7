"""When frames were recorded, from the times at which they are shown: even, uneven, or with frames that repeat."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.pace import USUAL_RATE

# Of the usual interval. Containers round times to a millisecond at worst, which is a tenth at 100 frames a second; a
# frame that was left out makes 1.
_UNEVEN = 0.2

_PACED = 25  # frames, the last of which tell the rate of a source
# Frames a second: slower sources are photographs one after another, of which as many are needed as of a video.
_SLOWEST, _FASTEST = 12.0, 240.0

_LONGEST_PERIOD = 12  # frames: 25 in 60 frames a second; telecine has 5, animation 4 at most
_LONGEST_OF_ONE = 6  # with a single repeat: 25 in 30; more lie between keyframes, after which encoders skip frames
# What a cadence has to explain of the repeats, or all but one: the first repeat of a shot is missed.
_REGULAR, _LEAST_REPEATS = 0.9, 3


def frame_interval(indices: Sequence[int], timestamps: Sequence[float | None]) -> float:
    """Usual seconds between two neighbouring frames of the source, 0 if unknown.

    Args:
        indices: of some of its frames; timestamps: theirs, seconds.
    """
    times = [time for time in timestamps if time is not None]
    if len(times) < max(2, len(timestamps)):
        return 0.0
    gaps = np.diff(indices)
    return max(float(np.median(np.diff(times) / gaps)), 0.0) if (gaps > 0).all() else 0.0


class Pace:
    """The rate at which the frames of a source come, as far as their timestamps tell.

    Args:
        seen: what `state` gave.
    """

    def __init__(self, seen: Iterable[tuple[int, float | None]] = ()) -> None:
        self._seen = deque(((index, time) for index, time in seen), _PACED)
        self.rate = USUAL_RATE  # frames a second

    def push(self, index: int, timestamp: float | None) -> float:
        """The rate with the next frame, frames a second."""
        self._seen.append((index, timestamp))
        interval = frame_interval(*zip(*self._seen, strict=True))
        self.rate = min(max(1.0 / interval, _SLOWEST), _FASTEST) if interval > 0.0 else USUAL_RATE
        return self.rate

    def state(self) -> list[tuple[int, float | None]]:
        """Plain data, of which another one is made."""
        return list(self._seen)


def frame_times(indices: Sequence[int], timestamps: Sequence[float | None]) -> NDArray[np.float64]:
    """(n,) times of frames, 1 apart where two neighbours of the source are: the timestamps where these are uneven.

    Where they are even or unknown, or do not rise, the times are the indices.

    Args:
        indices: of the frames; timestamps: theirs, seconds.
    """
    even = np.array(indices, np.float64)
    interval = frame_interval(indices, timestamps)
    if not interval > 0:
        return even
    times = np.array(timestamps, np.float64) / interval
    steps = np.diff(times)
    uneven = (steps > 0).all() and np.abs(steps - np.diff(even)).max() > _UNEVEN
    return times - times[0] + even[0] if uneven else even


def are_uneven(indices: Sequence[int], timestamps: Sequence[float | None]) -> bool:
    """Whether frames come at uneven times; arguments as in `frame_times`."""
    return not np.array_equal(frame_times(indices, timestamps), indices)


def cadence(repeated: Sequence[bool]) -> tuple[int, int] | None:
    """The rhythm of frames that repeat the one before: in every so many frames so many are new; None without one.

    Args:
        repeated: of each frame of a shot, in order.
    """
    flags = np.asarray(repeated, bool)
    for period in range(2, min(_LONGEST_PERIOD, len(flags) // 3) + 1):
        pattern = np.array([flags[phase::period].mean() > 0.5 for phase in range(period)])
        expected = np.resize(pattern, len(flags))
        matched, either = int((expected & flags).sum()), int((expected | flags).sum())
        new = int((~pattern).sum())
        if new == period - 1 and period > _LONGEST_OF_ONE:
            continue
        if matched >= max(min(_REGULAR * either, either - 1), _LEAST_REPEATS):
            return period, new
    return None
