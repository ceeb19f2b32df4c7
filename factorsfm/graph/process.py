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
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import spawn
from pathlib import Path
from typing import IO, TypeVar, cast

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.server import Answer, Request
from factorsfm.support.context import Closing
from factorsfm.support.errors import FactorsfmError

Subject = TypeVar("Subject")
Result = TypeVar("Result")

# The same package and libraries as here, but nothing that is imported for the user's sake only: half of the start.
_MAIN = """
import importlib, sys, types
folder, module, *sys.path = sys.argv[1:]
for name in ("factorsfm", "factorsfm.priors"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [folder + name.removeprefix("factorsfm").replace(".", "/")]
from factorsfm.graph.server import serve
importlib.import_module(module)
serve()
"""
_SECONDS_TO_END = 5.0  # for a process whose output has ended
# For an answer. An update takes less than a second: a machine that swaps or has no core free may take a hundred times
# as long, but whoever waits longer waits for a process that hangs.
_SECONDS_TO_ANSWER = 60.0


class GraphProcess(Closing):
    """Updates of one graph, made one after the other beside everything else.

    Args:
        module: of the updates, which the process imports before it is asked for one.
    """

    def __init__(self, module: str = KeyframeGraph.__module__) -> None:
        self._worker = ThreadPoolExecutor(1, "factorsfm-graph")
        self._anew, self._module = True, module
        self._process: _Process | None = _Process(module)

    def submit(self, work: Callable[[], Result]) -> Future[Result]:
        """Do some work in a thread beside everything else, after all that was submitted before; it may `ask`."""
        return self._worker.submit(work)

    def ask(self, update: Callable[[Subject, KeyframeGraph], Result], subject: Subject) -> Result:
        """``update(subject, graph)`` in the process; raises what it raises there.

        Args:
            update: a function of a module; subject: crosses to the process, as the result crosses back.

        Raises:
            GraphProcessKilledError: the process was killed meanwhile; the next update has another one, and an empty
                graph.
            FactorsfmError: the process ended by itself, which another one would do, too.
        """
        request, self._anew = Request(update, subject, self._anew), False
        process, self._process = self._process or _Process(self._module), None
        try:
            answer = process.ask(request)
        except BaseException:  # Ctrl-C, too: this answer must not be taken for that of the next request
            process.close()
            raise
        self._process = process
        for name, level, message in answer.log:
            logging.getLogger(name).log(level, message)
        if isinstance(answer.outcome, Exception):
            raise answer.outcome
        return cast(Result, answer.outcome)

    def start_anew(self) -> None:
        """The next update begins another map."""
        self._anew = True

    def close(self) -> None:
        """Wait for an update that is being made, and end the process; further updates are lost."""
        self._worker.shutdown(cancel_futures=True)
        if self._process is not None:
            self._process.close()


class GraphProcessKilledError(FactorsfmError):
    """A process was killed: from outside, by a crash, or because it gave no answer or none that can be understood."""


class _Process:
    """The other side; it ends with this one, however this one ends."""

    def __init__(self, module: str) -> None:
        package = Path(__file__).parents[1]
        path = [entry or os.getcwd() for entry in sys.path]
        command = [spawn.get_executable(), "-c", _MAIN, str(package), module, *path]
        # A group of its own, so that Ctrl-C in a terminal does not reach it even before it can ignore signals.
        self._popen = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        self._end = weakref.finalize(self, _end, self._popen)

    def ask(self, request: Request) -> Answer:
        """Send a request and wait for the answer; after an error there must be no other request.

        Raises:
            GraphProcessKilledError: the process was killed meanwhile, or did not answer as it should.
            FactorsfmError: it ended by itself.
        """
        data = pickle.dumps(request, pickle.HIGHEST_PROTOCOL)
        begin = time.monotonic()
        try:
            answer = self._answer(data)
        except Exception as error:  # whatever a torn pickle may raise
            if time.monotonic() - begin > _SECONDS_TO_ANSWER:
                reason = f"killed because it gave no answer within {_SECONDS_TO_ANSWER:g} s"
                raise GraphProcessKilledError(f"the process of the graph was {reason}") from error
            raise self._failure(error) from error
        if not isinstance(answer, Answer):
            raise GraphProcessKilledError(_not_understood(f"it is of type {type(answer).__name__}"))
        return answer

    def _answer(self, data: bytes) -> object:
        """To a request; a process that gives none in time is killed, and none any more when this returns."""
        requests, answers = _pipes(self._popen)
        limit = threading.Timer(_SECONDS_TO_ANSWER, self._popen.kill)
        limit.start()
        try:
            requests.write(data)
            requests.flush()
            return pickle.load(answers)
        finally:
            limit.cancel()
            limit.join()

    def _failure(self, error: Exception) -> FactorsfmError:
        """What has become of a process whose answer cannot be read."""
        try:
            code = self._popen.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            return GraphProcessKilledError(_not_understood(repr(error)))
        if code < 0:
            return GraphProcessKilledError(f"the process of the graph was killed by {signal.Signals(-code).name}")
        return FactorsfmError(f"the process of the graph ended with status {code}, see standard error")

    def close(self) -> None:
        self._end()


def _not_understood(reason: str) -> str:
    return f"the process of the graph was killed because its answer cannot be understood: {reason}"


def _pipes(popen: subprocess.Popen[bytes]) -> tuple[IO[bytes], IO[bytes]]:
    assert popen.stdin is not None
    assert popen.stdout is not None
    return popen.stdin, popen.stdout


def _end(popen: subprocess.Popen[bytes]) -> None:
    """End a process, which has nothing to tidy up."""
    requests, answers = _pipes(popen)
    popen.kill()
    with contextlib.suppress(BrokenPipeError):  # something was left to be written
        requests.close()
    answers.close()
    popen.wait()
