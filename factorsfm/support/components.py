"""Connected components of an undirected graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]


def connected_components(count: int, edges: Index) -> Index:
    """(count,) label of the connected component of each node: the smallest node in it.

    Args:
        count: number of nodes.
        edges: (e, 2) pairs of nodes.
    """
    label = np.arange(count)
    while True:
        before = label.copy()
        a, b = label[edges[:, 0]], label[edges[:, 1]]
        smallest = np.minimum(a, b)
        np.minimum.at(label, a, smallest)
        np.minimum.at(label, b, smallest)
        while not np.array_equal(label, label[label]):
            label = label[label]
        if np.array_equal(label, before):
            return label
