"""Threads and processes that somebody has started and not ended."""

import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_PATIENCE_SECONDS = 2.0  # a thread that was told to end is gone in a moment


def children() -> set[int]:
    """Process ids of the processes that this one has started and that are alive, or have not been waited for."""
    found = subprocess.run(["pgrep", "-P", str(os.getpid())], capture_output=True, text=True)
    return {int(pid) for pid in found.stdout.split()}


@contextmanager
def nothing_left_alive() -> Iterator[None]:
    """Insists that the threads and processes at the end are those of the beginning."""
    threads, processes = set(threading.enumerate()), children()
    yield
    end = time.monotonic() + _PATIENCE_SECONDS
    while (left := set(threading.enumerate()) - threads) and time.monotonic() < end:
        time.sleep(0.01)
    assert not left
    assert children() <= processes  # what was forgotten before may have ended meanwhile
