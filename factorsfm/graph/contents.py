"""A copy of the keyframe graph, taken out of its process."""

from __future__ import annotations

from typing import TypeAlias

import gtsam

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess

Factors: TypeAlias = gtsam.NonlinearFactorGraph
Values: TypeAlias = gtsam.Values
LiveGraph = tuple[Factors, Values]


def empty_graph() -> LiveGraph:
    """No factors, no values."""
    return gtsam.NonlinearFactorGraph(), gtsam.Values()


def graph_contents(process: GraphProcess) -> LiveGraph:
    """Factors and estimate of the graph in a process, after all updates that were submitted before."""
    factors, estimate = process.submit(lambda: process.ask(_serialized, None)).result()
    graph, values = empty_graph()
    if factors:
        graph.deserialize(factors)
        values.deserialize(estimate)
    return graph, values


def _serialized(subject: None, graph: KeyframeGraph) -> tuple[str, str]:
    """GTSAM's own serialisation; empty of an empty graph."""
    factors, estimate = graph.contents()
    return (factors.serialize(), estimate.serialize()) if factors.size() else ("", "")
