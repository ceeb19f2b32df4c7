"""A factor graph, linearised, as one dense system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.keys import ordering_of

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """A linearised graph as one dense system ``derivative @ step = residual``, in standard deviations.

    Attributes:
        columns: of each variable.
    """

    derivative: Array
    residual: Array
    columns: dict[int, slice]

    @classmethod
    def of(cls, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, first: Sequence[int] = ()) -> LinearSystem:
        """Linearise at some values; the variables `first` have the first columns."""
        keys = [*first, *sorted(set(graph.keyVector()) - set(first))]
        dimension = values.dims()
        ends = np.cumsum([dimension[key] for key in keys]).tolist()
        columns = {key: slice(end - dimension[key], end) for key, end in zip(keys, ends, strict=True)}
        return cls(*graph.linearize(values).jacobian(ordering_of(keys)), columns)
