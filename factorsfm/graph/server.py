"""The process of the keyframe graph: requests on standard input, answers on standard output, until the input ends."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pycolmap  # noqa: F401  with the images; its import sets a handler of SIGTERM, which `serve` then replaces

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.support.threads import OneThreadEach


@dataclass(frozen=True, slots=True)
class Request:
    """An update to make: ``update(subject, graph)``, where asked for `anew` on an empty graph.

    Attributes:
        update: a function of a module, which crosses to the process by its name.
    """

    update: Callable[[Any, KeyframeGraph], Any]
    subject: Any
    anew: bool


@dataclass(frozen=True, slots=True)
class Answer:
    """What the update returned or raised, and its log records: logger, level, message."""

    outcome: Any
    log: list[tuple[str, int, str]]


class _Kept(logging.Handler):
    """Keeps what is logged for the next answer."""

    def __init__(self) -> None:
        super().__init__()
        self._log: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self._log.append((record.name, record.levelno, record.getMessage()))

    def taken(self) -> list[tuple[str, int, str]]:
        log, self._log = self._log, []
        return log


def serve() -> None:
    """Answer requests until nobody can send any."""
    for number in (signal.SIGINT, signal.SIGTERM):  # what ends the parent ends this process, too, but not before
        signal.signal(number, signal.SIG_IGN)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    with open(os.devnull, "wb") as nowhere:  # GTSAM prints of every landmark behind a camera that it tries
        os.dup2(nowhere.fileno(), sys.stdout.fileno())
    kept = _Kept()
    logging.getLogger().addHandler(kept)
    graph = KeyframeGraph()
    with OneThreadEach(), contextlib.suppress(EOFError, BrokenPipeError, pickle.UnpicklingError):
        while True:
            request: Request = pickle.load(sys.stdin.buffer)
            if request.anew:
                graph = KeyframeGraph()
            outcome = _outcome(request, graph)
            answers.write(pickle.dumps(Answer(outcome, kept.taken()), pickle.HIGHEST_PROTOCOL))
            answers.flush()
            graph.prepare()
    os._exit(0)  # at once: there is nothing to tidy up


def _outcome(request: Request, graph: KeyframeGraph) -> Any:
    try:
        return request.update(request.subject, graph)
    except Exception as error:
        error.add_note(f"In the process of the graph: {traceback.format_exc()}")
        return error
