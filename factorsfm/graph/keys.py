"""Keys of variables: their letters and names, those of a graph, and the values and orderings that belong to them."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam


def letter_of(key: int) -> str:
    """The character of a key's symbol."""
    return chr(gtsam.symbolChr(key))


def name_of(key: int) -> str:
    """A key as GTSAM writes it."""
    return str(gtsam.DefaultKeyFormatter(key))


def keys_of(graph: gtsam.NonlinearFactorGraph) -> set[int]:
    """The variables of some factors."""
    return {key for k in range(graph.size()) for key in list(graph.at(k).keys())}


def part_of(values: gtsam.Values, keys: Iterable[int]) -> gtsam.Values:
    """The values of some variables, of those that there are."""
    return values.extract([key for key in keys if values.exists(key)])


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """The variables in this order."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering
