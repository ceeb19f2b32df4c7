"""Updates that no map asks for, which the process of the graph imports by name."""

import os
import time
from typing import Any

from factorsfm.graph import server
from factorsfm.graph.keyframe_graph import KeyframeGraph


class Torn:
    """What cannot be read where it arrives."""

    def __reduce__(self) -> Any:
        return int, ("torn",)


def echo(subject: Any, graph: KeyframeGraph) -> Any:
    return subject


def pid(subject: Any, graph: KeyframeGraph) -> int:
    return os.getpid()


def slow_echo(subject: Any, graph: KeyframeGraph) -> Any:
    time.sleep(1.0)
    return subject


def print_from_a_library(subject: Any, graph: KeyframeGraph) -> Any:
    os.write(1, b"landmark behind a camera\n")
    return subject


def never(subject: Any, graph: KeyframeGraph) -> None:
    time.sleep(1000.0)


def torn(subject: Any, graph: KeyframeGraph) -> Torn:
    return Torn()


def no_answer(subject: Any, graph: KeyframeGraph) -> None:
    """Instead of its answer the process sends a word."""
    server.Answer = lambda outcome, log: "hello"
