"""Time of a call, and the noise of the problems that are timed."""

from __future__ import annotations

import time
from collections.abc import Callable

PIXEL_SIGMA = 0.25  # standard deviation of an observation, pixels
DEPTH_SIGMA = 0.05  # standard deviation of the depth prior, relative to the median inverse depth
KERNEL = 2.0  # scale of the Cauchy kernel in standard deviations

_REPEATS = 5


def seconds(call: Callable[[], object]) -> float:
    """Time of a call: the shortest of several, because other work on the machine only adds to it."""
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)
