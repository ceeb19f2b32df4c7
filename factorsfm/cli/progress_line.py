"""The line of progress on a terminal, and log lines above it."""

from __future__ import annotations

import logging
import shutil
import time
from typing import TextIO

from factorsfm.support.context import Closing


class ProgressLine(Closing):
    """A `Progress` that rewrites one line on a terminal; does nothing if it is not enabled."""

    _SECONDS_BETWEEN = 0.1

    def __init__(self, stream: TextIO, enabled: bool) -> None:
        self._stream = stream
        self._enabled = enabled
        self._stage = ""
        self._written = 0.0
        self._shown = False

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        count = f" {done}/{total}" if total is not None else f" {done}" if done else ""
        self.show(f"{stage}{count}", at_once=stage != self._stage)
        self._stage = stage

    def show(self, text: str, at_once: bool = False) -> None:
        """Replace the line; texts in quick succession are skipped."""
        now = time.monotonic()
        if not self._enabled or (not at_once and now < self._written + self._SECONDS_BETWEEN):
            return
        self._written, self._shown = now, True
        columns = shutil.get_terminal_size().columns
        self._stream.write(f"\r\x1b[K{text[: columns - 1]}")
        self._stream.flush()

    def clear(self) -> None:
        """Remove the line."""
        if self._shown:
            self._stage, self._shown = "", False
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def close(self) -> None:
        self.clear()


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes log lines to stderr; the line of progress gives way.

    Args:
        all_alike: show also the lines that say what others have said; else they are counted, and `say_rest` tells.
    """

    _MOST_ALIKE = 3  # lines from one place in the program: enough to see which files or frames it is about

    def __init__(self, line: ProgressLine, *, all_alike: bool) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        self._line, self._all = line, all_alike
        self._shown: dict[tuple[str, int], set[str]] = {}  # texts, by logger and line of code
        self._rest: dict[
            tuple[str, int], tuple[logging.LogRecord, int]
        ] = {}  # the last one that is not shown, how many

    def emit(self, record: logging.LogRecord) -> None:
        if not self._all:
            place, text = (record.name, record.lineno), record.getMessage()
            shown = self._shown.setdefault(place, set())
            if text in shown or len(shown) >= self._MOST_ALIKE:
                self._rest[place] = record, self._rest.get(place, (record, 0))[1] + 1
                return
            shown.add(text)
        self._line.clear()
        super().emit(record)

    def say_rest(self) -> None:
        """How many lines were not shown, and the last one of each sort."""
        for record, count in self._rest.values():
            head = f"{record.levelname} {record.name}: {count} more"
            self.stream.write(f"{head} like this: {record.getMessage()}\n")
        self._rest.clear()
