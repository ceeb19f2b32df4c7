"""One thread each: how many threads BLAS and OpenCV have while somebody holds them to one, and afterwards."""

import gc
import subprocess
import sys
from weakref import WeakSet

import cv2
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from factorsfm.support.threads import OneThreadEach

# A holder that is closed dies in the collection that runs while the next one is being made.
COLLECTED_INSIDE = """
import gc
from factorsfm.support import threads

gc.disable()
holder = threads.OneThreadEach()
holder.close()
holder.itself = holder
del holder
limits = threads.threadpool_limits
threads.threadpool_limits = lambda *arguments: (gc.collect(), limits(*arguments))[1]
threads.OneThreadEach().close()
print("done")
"""


def threads() -> tuple[int, list[int]]:
    """Of OpenCV, and of each BLAS."""
    return cv2.getNumThreads(), [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@pytest.fixture(autouse=True)
def _several_threads(monkeypatch):
    """Three threads each, and nobody who holds them: streams of other tests may still be open."""
    monkeypatch.setattr(OneThreadEach, "_open", WeakSet())
    monkeypatch.setattr(OneThreadEach, "_before", None)
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    with threadpool_limits(3, "blas"):
        yield
    cv2.setNumThreads(before)


def test_the_last_one_to_close_gives_back_what_was_before():
    before = threads()
    with OneThreadEach() as first:
        one = threads()
        assert one == (1, [1] * len(before[1]))
        with OneThreadEach():
            assert threads() == one
        first.close()
        assert threads() == before
        with OneThreadEach():
            assert threads() == one
            first.close()  # a second time: it holds nothing any more
            assert threads() == one
    assert threads() == before


def test_one_that_is_forgotten_holds_nobody_up():
    before = threads()
    forgotten = OneThreadEach()
    del forgotten
    gc.collect()
    with OneThreadEach():
        assert threads()[0] == 1
    assert threads() == before


def test_a_collection_while_one_is_made_does_not_wait_for_ever():
    done = subprocess.run([sys.executable, "-c", COLLECTED_INSIDE], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("done\n", "")
