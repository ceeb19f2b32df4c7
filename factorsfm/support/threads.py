"""One thread for each numerical library while a reconstruction runs, and the cores that a process may use.

Matrices and images are small here. On cores that have other work to do, the threads of BLAS and OpenCV would spend more
time waiting for each other than working; what runs side by side are tracking, the graph and the decoder.
"""

from __future__ import annotations

import os
import threading

import cv2
from threadpoolctl import threadpool_limits

from factorsfm.support.context import Closing


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class OneThreadEach(Closing):
    """Holds BLAS and OpenCV to one thread until it is closed; the last one to close gives back what was before."""

    _lock = threading.Lock()
    _holders = 0
    _blas: threadpool_limits
    _opencv = 0

    def __init__(self) -> None:
        self._open = True
        cls = OneThreadEach
        with cls._lock:
            if cls._holders == 0:
                cls._blas, cls._opencv = threadpool_limits(1, "blas"), cv2.getNumThreads()
                cv2.setNumThreads(1)
            cls._holders += 1

    def close(self) -> None:
        """Give the threads back, if nobody else holds them; more than one call is as good as one."""
        cls = OneThreadEach
        with cls._lock:
            cls._holders -= self._open
            if self._open and cls._holders == 0:
                cls._blas.restore_original_limits()
                cv2.setNumThreads(cls._opencv)
            self._open = False

    def __del__(self) -> None:
        self.close()
