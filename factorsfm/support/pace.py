"""Times of a video as numbers of frames."""

from __future__ import annotations

USUAL_RATE = 24.0  # frames a second, where a source says nothing of time


def frames_in(seconds: float, rate: float) -> int:
    """How many frames come in a time, at least one; `rate`: of the source, frames a second."""
    return max(1, round(seconds * rate))
