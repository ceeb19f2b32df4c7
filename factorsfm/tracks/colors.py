"""The colours of tracks, from the frames in which they start."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class TrackColors:
    """The colours of n tracks; a track's id is its row.

    Attributes:
        table: (n, 3) uint8 RGB.
    """

    def __init__(self, table: NDArray[np.uint8] | None = None) -> None:
        self.table = np.zeros((0, 3), np.uint8) if table is None else table

    def remember(self, image: NDArray[np.uint8], ids: NDArray[np.int64], xy: NDArray[np.float64]) -> None:
        """Add the colours of the tracks that are new.

        Args:
            image: (h, w, 3) BGR.
            ids: (n,) of the tracks, which count up as tracks start.
            xy: (n, 2) pixels, centres at integers.
        """
        new = ids >= len(self.table)
        if not new.any():
            return
        x, y = np.rint(xy[new]).astype(int).T
        pixels = image[y, x].reshape(int(new.sum()), -1)
        added = np.zeros((int(ids.max()) + 1 - len(self.table), 3), np.uint8)
        added[ids[new] - len(self.table)] = pixels[:, ::-1]
        self.table = np.concatenate([self.table, added])
