"""A folder of images that is still being filled."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.folders import list_images, natural_key, read_image, stated_pixel_aspect
from factorsfm.frames.frame import Frame
from factorsfm.frames.name_times import times_in
from factorsfm.frames.numbering import refuse_mixture
from factorsfm.frames.sequences import LONG, sequence_numbers
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.1  # between two listings
_PATIENCE_SECONDS = 2.0  # a file that has not changed for so long and cannot be decoded is damaged


def watch_folder(folder: Path, end_file: str | Path | None, closed: threading.Event) -> Iterator[Frame]:
    """Images of a folder that is still being filled, in natural order, each once it is complete.

    An image that cannot be decoded, that appears after a later one was taken, or that does not go on with a long
    sequence is left out with a warning.

    Args:
        end_file: when this file exists (a name in the folder, or a path), the folder is complete.
        closed: set by another thread when no further frames are wanted.

    Raises:
        InputError: while iterating, if the folder holds several sequences before one is long, or negative numbers.
    """
    taken: set[str] = set()
    last: Path | None = None
    newest: deque[str] = deque(maxlen=LONG)  # names of the images taken last
    arrivals: dict[Path, _Arrival] = {}
    index = -1
    while not closed.is_set():
        complete = end_file is not None and (folder / end_file).exists()  # tested before the folder is listed
        paths = list_images(folder)
        if len(newest) < LONG:  # else it is known what goes on with them
            refuse_mixture(folder, [path.name for path in paths])
        waiting = [path for path in paths if path.name not in taken]
        arrivals = {path: _Arrival.seen(path, arrivals.get(path)) for path in waiting}
        is_long = len(newest) == LONG and sequence_numbers(newest) is not None
        for path, arrival in arrivals.items():
            # Alone a name says its number; beside others a stray file might not go on with theirs.
            numbers = sequence_numbers([path.name] if last is None else [last.name, path.name])
            cause = ""
            if last is not None and natural_key(path) < natural_key(last):
                cause = f"it appeared after {last.name}"
            elif last is not None and is_long and numbers is None:
                cause = f"it does not go on with the sequence of {last.name}"
            image = None if cause else arrival.image(path)
            if image is None and not cause and not arrival.is_damaged():
                break
            taken.add(path.name)
            if image is None:
                logger.warning("image %s is left out: %s", path, cause or "it is damaged")
                continue
            index = index + 1 if numbers is None or numbers[-1] <= index else numbers[-1]
            last = path
            newest.append(path.name)
            times, aspect = times_in([path.name]), stated_pixel_aspect(path)
            yield Frame(index, image, path.name, times[0] if times else None, path=path, pixel_aspect=aspect)
        else:
            if complete:
                return
        closed.wait(_POLL_SECONDS)


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A file at one listing of the folder.

    Attributes:
        state: its size and time of change; None if it is gone.
        since: monotonic time at which it was first seen in this state, seconds.
        settled: whether it was in this state at the listing before.
    """

    state: tuple[int, int] | None
    since: float
    settled: bool

    @staticmethod
    def seen(path: Path, before: _Arrival | None) -> _Arrival:
        try:
            status = path.stat()
        except OSError:  # renamed or removed after the listing
            state = None
        else:
            state = (status.st_size, status.st_mtime_ns)
        if before is None or before.state != state:
            return _Arrival(state, time.monotonic(), False)
        return _Arrival(state, before.since, True)

    def image(self, path: Path) -> NDArray[np.uint8] | None:
        """The image, None while the file is not complete."""
        if not self.settled:
            return None
        try:
            return read_image(path)
        except InputError:
            return None

    def is_damaged(self) -> bool:
        """Whether a file that cannot be decoded has not changed for so long that nothing more is to come."""
        return time.monotonic() - self.since > _PATIENCE_SECONDS
