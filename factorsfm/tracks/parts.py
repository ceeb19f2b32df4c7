"""Work on the rows of an array in parts, on two cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Rows = NDArray[np.intp]

_WORTH_TWO_PARTS = 250  # rows; for fewer, preparing an image twice takes longer than following half of them


def in_parts(
    function: Callable[[Rows], tuple[Array, NDArray[np.bool_]]], count: int, pool: ThreadPoolExecutor
) -> tuple[Array, NDArray[np.bool_]]:
    """Apply a function to the rows 0 to count - 1 in parts, and concatenate its results.

    Args:
        function: from rows to one value and one flag for each.
    """
    parts = np.array_split(np.arange(count), 2 if count > _WORTH_TWO_PARTS else 1)
    values, flags = zip(*pool.map(function, parts), strict=True)
    return np.concatenate(values), np.concatenate(flags)
