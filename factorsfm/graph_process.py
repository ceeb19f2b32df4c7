"""The keyframe graph in a process of its own.

GTSAM holds Python's lock while it solves, so that a graph in a thread would keep the tracking waiting. The process is
started by hand: it must not run the user's script again, as `multiprocessing` would, and a fork has none of the
threads that the libraries here rely on.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import spawn
from pathlib import Path
from typing import IO

from factorsfm.closing import Closing
from factorsfm.errors import FactorsfmError
from factorsfm.graph import FactorGraph
from factorsfm.graph_server import Answer, Request
from factorsfm.map_update import MapCopy, MapUpdate, update_map
from factorsfm.registration import ImageDepth

logger = logging.getLogger(__name__)

# The same package and libraries as here, but nothing that only `factorsfm/__init__.py` imports: half of the start.
_MAIN = """
import sys, types
package = types.ModuleType("factorsfm")
package.__path__ = [sys.argv[1]]
sys.modules["factorsfm"], sys.path = package, sys.argv[2:]
from factorsfm.graph_server import serve
serve()
"""
_SECONDS_TO_END = 5.0


class GraphProcess(Closing):
    """Updates of one map, made one after the other beside everything else.

    The graph outlives its process: where that ends unexpectedly, the update is rolled back, and another process builds
    the graph from the map with the next one.
    """

    def __init__(self) -> None:
        self._worker = ThreadPoolExecutor(1, "factorsfm-graph")
        self._anew = True
        self._process = _take()
        self._give_back = weakref.finalize(self, _keep, self._process)
        self._give_back.atexit = False

    def submit(self, copy: MapCopy, read_depth: Callable[[], ImageDepth | None] | None) -> Future[MapUpdate]:
        """Make an update (see `update_map`), which raises what it raises there.

        Args:
            copy: of the map; read_depth: gives the prior of the new keyframe, called from another thread.
        """
        return self._worker.submit(self._update, copy, read_depth)

    def start_anew(self) -> None:
        """The next update begins another map."""
        self._anew = True

    def close(self) -> None:
        """Wait for an update that is being made; others are lost."""
        self._worker.shutdown(cancel_futures=True)
        self._give_back()

    def _update(self, copy: MapCopy, read_depth: Callable[[], ImageDepth | None] | None) -> MapUpdate:
        if read_depth is not None:
            copy.read_depth(read_depth)
        if len(copy.keyframes) == 1:  # is the world, and no matter of the graph: no need to wait for a process
            return update_map(copy, FactorGraph())
        request, self._anew = Request(copy.needed(), self._anew), False
        try:
            answer = self._process.ask(request)
        except _EndedError as error:
            tracks = copy.newest.tracks
            logger.warning("update at frame %d rolled back: %s", tracks.position, error)
            return MapUpdate(tracks.position, tracks.depth, False, str(error))
        for name, level, message in answer.log:
            logging.getLogger(name).log(level, message)
        if isinstance(answer.outcome, Exception):
            raise answer.outcome
        return answer.outcome


class _EndedError(Exception):
    """A process was killed, from outside or by a crash; another one has been started."""


class _Process:
    """The other side; it ends with this one, however this one ends."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        package = Path(__file__).parent
        path = [entry or os.getcwd() for entry in sys.path]
        command = [spawn.get_executable(), "-c", _MAIN, str(package), *path]
        # A group of its own, so that Ctrl-C in a terminal does not reach it even before it can ignore signals.
        self._popen = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        self._end = weakref.finalize(self, _end, self._popen)

    @property
    def lives(self) -> bool:
        return self._popen.poll() is None

    def ask(self, request: Request) -> Answer:
        """Send a request and wait for the answer.

        Raises:
            _EndedError: the process was killed meanwhile.
            FactorsfmError: it failed, which is no accident that another one would be spared.
        """
        requests, answers = _pipes(self._popen)
        data = pickle.dumps(request, pickle.HIGHEST_PROTOCOL)
        try:
            requests.write(data)
            requests.flush()
            answer: Answer = pickle.load(answers)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._popen.wait(_SECONDS_TO_END)
            self._end()
            code = self._popen.returncode
            if code >= 0:
                raise FactorsfmError(
                    f"the process of the graph ended with status {code}, see standard error"
                ) from error
            self._start()
            raise _EndedError(f"the process of the graph was killed by {signal.Signals(-code).name}") from error
        return answer

    def close(self) -> None:
        self._end()


def _pipes(popen: subprocess.Popen[bytes]) -> tuple[IO[bytes], IO[bytes]]:
    assert popen.stdin is not None
    assert popen.stdout is not None
    return popen.stdin, popen.stdout


def _end(popen: subprocess.Popen[bytes]) -> None:
    """End a process, which has nothing to tidy up."""
    requests, answers = _pipes(popen)
    with contextlib.suppress(BrokenPipeError):  # something was left to be written
        requests.close()
    answers.close()
    popen.kill()
    popen.wait()


# One process is kept for the next map: a start costs as much as the tracking of ten frames or more.
_kept: list[_Process] = []


def _take() -> _Process:
    """A process that nobody else uses."""
    while _kept:
        if (process := _kept.pop()).lives:
            return process
        process.close()
    return _Process()


def _keep(process: _Process) -> None:
    if _kept:
        process.close()
    else:
        _kept.append(process)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_kept.clear)  # two processes must not talk to the same one
