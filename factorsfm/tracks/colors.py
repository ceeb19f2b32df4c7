"""The colours of tracks, as they were where each was seen first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class TrackColors:
    """Colours by track id, which ascend in the order of appearance.

    Attributes:
        table: (n, 3) RGB.
    """

    def __init__(self, table: NDArray[np.uint8] | None = None) -> None:
        self.table = np.zeros((0, 3), np.uint8) if table is None else table

    def remember(self, image: NDArray[np.uint8], ids: NDArray[np.int64], xy: NDArray[np.float64]) -> None:
        """Keep the colours of the tracks that are new, at pixels (n, 2) of a BGR image."""
        fresh = ids >= len(self.table)
        if not fresh.any():
            return
        x, y = np.rint(xy[fresh]).astype(int).T
        pixels = image[y, x].reshape(int(fresh.sum()), -1)
        added = np.zeros((int(ids.max()) + 1 - len(self.table), 3), np.uint8)
        added[ids[fresh] - len(self.table)] = pixels[:, ::-1]
        self.table = np.concatenate([self.table, added])
