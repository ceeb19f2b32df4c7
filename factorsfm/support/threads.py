"""One thread for each numerical library while a reconstruction runs, and the cores that a process may use.

Matrices and images are small here. On cores that have other work to do, the threads of BLAS and OpenCV would spend more
time waiting for each other than working; what runs side by side are tracking, the graph and the decoder.
"""

from __future__ import annotations

import os
import threading
from typing import ClassVar
from weakref import WeakSet

import cv2
from threadpoolctl import threadpool_limits

from factorsfm.support.context import Closing


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class OneThreadEach(Closing):
    """Holds BLAS and OpenCV to one thread until it is closed; the last one to close gives back what was before.

    One that is forgotten unclosed does not count any more, but gives nothing back: the next one that closes does. A
    finaliser would have to take the lock, which the garbage collector may find taken by the thread that it interrupts.
    """

    _lock = threading.Lock()
    _open: ClassVar[WeakSet[OneThreadEach]] = WeakSet()
    _before: tuple[threadpool_limits, int] | None = None  # the threads of BLAS and of OpenCV; None while nobody holds

    def __init__(self) -> None:
        cls = OneThreadEach
        with cls._lock:
            cls._open.add(self)
            if cls._before is None:
                cls._before = threadpool_limits(1, "blas"), cv2.getNumThreads()
                cv2.setNumThreads(1)

    def close(self) -> None:
        """Give the threads back, if nobody else holds them; more than one call is as good as one."""
        cls = OneThreadEach
        with cls._lock:
            cls._open.discard(self)
            if cls._before is not None and not cls._open:
                (blas, opencv), cls._before = cls._before, None
                blas.restore_original_limits()
                cv2.setNumThreads(opencv)
