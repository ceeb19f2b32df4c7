"""Who does the work: this process, processes of this machine, or a Dask cluster, all behind one interface."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Generic, TypeVar

from factorsfm.support.errors import FactorsfmError, InputError

Job = TypeVar("Job")
Result = TypeVar("Result")

_TRIES_ALONE = 2
_CONNECT_SECONDS = 15
_EVERYTHING = 1_000_000  # a cluster has a queue of its own


class WorkerLostError(FactorsfmError):
    """A process ended in the middle of its job, again and again."""


class Crew:
    """Does jobs in any order, and survives the death of workers.

    Args:
        open_executor: gives so many workers, for as long as its context lasts.
        workers: how many jobs are handed out at a time.
    """

    def __init__(self, open_executor: Callable[[int], AbstractContextManager[Executor]], workers: int) -> None:
        self._open = open_executor
        self._workers = workers

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result | BaseException]]:
        """Each job with what `work` returned or raised, as they are finished.

        When a process of a pool ends unexpectedly, nobody can say whose fault it was. So whatever was in work is done
        again at the end, each job in a process of its own, twice at most.
        """
        round_ = _Round(work, jobs)
        while round_.waiting:
            yield from round_.run(self._open, self._workers)
        for job in round_.lost:
            for _ in range(_TRIES_ALONE):
                alone = _Round(work, [job])
                yield from alone.run(self._open, 1)
                if not alone.lost:
                    break
            else:
                yield job, WorkerLostError(f"its process ended unexpectedly, {1 + _TRIES_ALONE} times")


class _Round(Generic[Job, Result]):
    """Jobs that wait, and those that were lost with their process."""

    def __init__(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> None:
        self._work = work
        self.waiting = deque(jobs)
        self.lost: list[Job] = []

    def run(
        self, open_executor: Callable[[int], AbstractContextManager[Executor]], workers: int
    ) -> Iterator[tuple[Job, Result | BaseException]]:
        """Do the jobs until all are done or a process ends."""
        running: dict[Future[Result], Job] = {}
        try:
            with open_executor(workers) as executor:
                while self.waiting or running:
                    while self.waiting and len(running) < workers:
                        running[executor.submit(self._work, self.waiting[0])] = self.waiting[0]
                        self.waiting.popleft()
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        outcome = _outcome(future)
                        yield running.pop(future), outcome
        except BrokenExecutor:
            self.lost += running.values()


def _outcome(future: Future[Result]) -> Result | BaseException:
    try:
        return future.result()
    except BrokenExecutor:
        raise
    except Exception as error:
        return error


@contextmanager
def open_crew(workers: int, scheduler: str | None) -> Iterator[Crew]:
    """So many processes of this machine, this process alone for one, or the workers of a Dask scheduler.

    Raises:
        InputError: Dask is not installed, or its scheduler does not answer.
    """
    if scheduler is None:
        yield Crew(_processes if workers > 1 else _this_process, workers)
        return
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise InputError("a cluster needs Dask: pip install 'factorsfm[cluster]'") from error
    try:
        client = Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"the Dask scheduler {scheduler} does not answer: {error}") from error
    with client:
        # Not pure: a job whose result has been deleted is to be done again.
        yield Crew(lambda _: client.get_executor(pure=False), _EVERYTHING)


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    before = set(multiprocessing.active_children())
    # Spawned: the libraries here have threads, and a fork takes none of them along.
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _ignore_interrupts)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.kill()  # at Ctrl-C nobody waits for the end of a shot; libraries complain of softer signals
        raise
    pool.shutdown()


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _this_process(_: int) -> Iterator[Executor]:
    yield _AtOnce()


class _AtOnce(Executor):
    """Does a job when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future
