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
from typing import IO, TypeVar, cast

from factorsfm.graph.keyframe_graph import FactorGraph
from factorsfm.graph.server import Answer, Request
from factorsfm.support.context import Closing
from factorsfm.support.errors import FactorsfmError

Subject = TypeVar("Subject")
Result = TypeVar("Result")

# The same package and libraries as here, but nothing that only `factorsfm/__init__.py` imports: half of the start.
_MAIN = """
import sys, types
package = types.ModuleType("factorsfm")
package.__path__ = [sys.argv[1]]
sys.modules["factorsfm"], sys.path = package, sys.argv[2:]
from factorsfm.graph.server import serve
serve()
"""
_SECONDS_TO_END = 5.0


class GraphProcess(Closing):
    """Updates of one graph, made one after the other beside everything else."""

    def __init__(self) -> None:
        self._worker = ThreadPoolExecutor(1, "factorsfm-graph")
        self._anew = True
        self._process = _take()
        self._give_back = weakref.finalize(self, _keep, self._process)
        self._give_back.atexit = False

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Do some work in a thread beside everything else, after all that was submitted before; it may `ask`."""
        return self._worker.submit(work)

    def ask(self, update: Callable[[Subject, FactorGraph], Result], subject: Subject) -> Result:
        """``update(subject, graph)`` in the process; raises what it raises there.

        Args:
            update: a function of a module; subject: crosses to the process, as the result crosses back.

        Raises:
            GraphProcessKilledError: the process was killed meanwhile; the next update has another one, and an empty
                graph.
        """
        request, self._anew = Request(update, subject, self._anew), False
        answer = self._process.ask(request)
        for name, level, message in answer.log:
            logging.getLogger(name).log(level, message)
        if isinstance(answer.outcome, Exception):
            raise answer.outcome
        return cast(Result, answer.outcome)

    def start_anew(self) -> None:
        """The next update begins another map."""
        self._anew = True

    def close(self) -> None:
        """Wait for an update that is being made; others are lost."""
        self._worker.shutdown(cancel_futures=True)
        self._give_back()


class GraphProcessKilledError(FactorsfmError):
    """A process was killed, from outside or by a crash; another one has been started."""


class _Process:
    """The other side; it ends with this one, however this one ends."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        package = Path(__file__).parents[1]
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
            GraphProcessKilledError: the process was killed meanwhile.
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
            raise GraphProcessKilledError(
                f"the process of the graph was killed by {signal.Signals(-code).name}"
            ) from error
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
