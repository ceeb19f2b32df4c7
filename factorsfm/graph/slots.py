"""Where the factors of a graph are: the slot of each measurement in iSAM2."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Slots:
    """Slots of the factors of one kind, each named by a keyframe and a track."""

    def __init__(self, keyframe: Index | None = None, track: Index | None = None, slot: Index | None = None) -> None:
        none = np.zeros(0, np.int64)
        self.keyframe = none if keyframe is None else keyframe
        self.track = none if track is None else track
        self.slot = none if slot is None else slot

    def __len__(self) -> int:
        return len(self.slot)

    def copy(self) -> Slots:
        """An independent copy."""
        return Slots(self.keyframe, self.track, self.slot)

    def missing(self, keyframe: Index, track: Index) -> Mask:
        """(n,) which of these measurements have no factor."""
        return ~np.isin(_code(keyframe, track), _code(self.keyframe, self.track), assume_unique=True)

    def add(self, keyframe: Index, track: Index, slot: Index) -> None:
        """Take note of new factors."""
        self.keyframe = np.concatenate([self.keyframe, keyframe])
        self.track = np.concatenate([self.track, track])
        self.slot = np.concatenate([self.slot, slot])

    def take(self, chosen: Mask) -> Index:
        """Forget some of the factors; their slots."""
        taken = self.slot[chosen]
        self.keyframe, self.track, self.slot = self.keyframe[~chosen], self.track[~chosen], self.slot[~chosen]
        return taken


def _code(keyframe: Index, track: Index) -> Index:
    return (keyframe << 32) + track
