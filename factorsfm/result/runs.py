"""Runs of frames of which something is to be said."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MERGED_GAP = 5  # frames between two stretches that are told as one
_SHORTEST = 3  # frames


def runs(marked: NDArray[np.bool_]) -> list[slice]:
    """The runs of marked frames, in order; runs with a short gap between are one, and short ones are none."""
    rows = np.nonzero(marked)[0]
    parts = np.split(rows, np.nonzero(np.diff(rows) > _MERGED_GAP + 1)[0] + 1)
    return [slice(run[0], run[-1] + 1) for run in parts if len(run) >= min(_SHORTEST, len(marked))]
