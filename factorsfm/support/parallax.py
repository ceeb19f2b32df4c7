"""Parallax of a camera path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def parallax(centers: Array, inverse_depths: Array) -> float:
    """Largest distance of a camera from the first one over the median depth of the points (paper, section 4).

    Args:
        centers: (n, 3) camera centres.
        inverse_depths: (m,) of the points, in the inverse unit of the centres; 0 for a point at infinity.
    """
    moved = np.linalg.norm(centers - centers[0], axis=1)
    return float(moved.max() * max(float(np.median(inverse_depths)), 0.0))
