"""Ctrl-C in a stream: the first one ends the input, and the result is written."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from factorsfm.frames.frame import Frame


class Interrupt:
    """The first Ctrl-C ends the input after the current frame; the second one ends the program."""

    def __init__(self) -> None:
        self._asked = False
        self._waiting = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._asked = True
        if self._waiting:
            raise KeyboardInterrupt

    def until(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """The frames before the interrupt."""
        while not self._asked:
            try:
                self._waiting = True
                frame = next(frames, None)
                self._waiting = False
            except KeyboardInterrupt:
                return
            if frame is None:
                return
            yield frame


@contextmanager
def first_interrupt() -> Iterator[Interrupt]:
    """Handles Ctrl-C within its context."""
    interrupt = Interrupt()
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)
