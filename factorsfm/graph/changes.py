"""What an update changes of the factors and values of iSAM2."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import gtsam
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]


class Changes:
    """What an update adds to iSAM2 and removes from it, and who wants to know the slots of what is added."""

    def __init__(self) -> None:
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.removed: list[int] = []
        self._added: list[tuple[int, Callable[[Index], None]]] = []  # end among the new factors, and who is told

    def add(self, factors: Iterable[gtsam.NonlinearFactor], told: Callable[[Index], None]) -> None:
        """Add factors; `told` is called with their slots after the update."""
        for factor in factors:
            self.graph.add(factor)
        self._added.append((self.graph.size(), told))

    def settle(self, slots: Index) -> None:
        """After the update: the slots of the new factors, in the order in which they were added."""
        begin = 0
        for end, told in self._added:
            told(slots[begin:end])
            begin = end
