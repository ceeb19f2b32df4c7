"""The rows of the tracker: tracks that are alive, and tracks that have ended and may be revived."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.patches import BirthPatches

Array = NDArray[np.float32]
Ids = NDArray[np.int64]
Rows = NDArray[np.intp]

_MOST_ENDED = 3000  # ended tracks that are remembered


class LiveTracks:
    """The n tracks that are alive in the present frame.

    Attributes:
        ids: (n,) ascending.
        xy: (n, 2) pixels, centres at integers.
        velocity: (n, 2) pixels per frame.
        patches: their birth patches.
    """

    def __init__(self, window_px: int) -> None:
        self.ids: Ids = np.zeros(0, np.int64)
        self.xy: Array = np.zeros((0, 2), np.float32)
        self.velocity: Array = np.zeros((0, 2), np.float32)
        self.patches = BirthPatches(window_px)

    def __len__(self) -> int:
        return len(self.ids)

    def append(self, ids: Ids, xy: Array, velocity: Array, patches: BirthPatches) -> None:
        """Add tracks behind the others."""
        self.ids = np.r_[self.ids, ids]
        self.xy = np.r_[self.xy, xy].astype(np.float32)
        self.velocity = np.r_[self.velocity, velocity]
        self.patches.append(patches)

    def keep(self, index: NDArray[np.bool_] | Rows) -> None:
        """Keep some of the tracks, or all in another order."""
        self.ids = self.ids[index]
        self.xy = self.xy[index]
        self.velocity = self.velocity[index]
        self.patches.keep(index)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        return {"ids": self.ids, "xy": self.xy, "velocity": self.velocity, "patches": self.patches.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.ids, self.xy, self.velocity = state["ids"], state["xy"], state["velocity"]
        self.patches.restore(state["patches"])


class EndedTracks:
    """Tracks that have ended, with their birth patches; the oldest are forgotten.

    Attributes:
        ids: (n,) in the order in which they ended.
        patches: their birth patches.
    """

    def __init__(self, window_px: int) -> None:
        self.ids: Ids = np.zeros(0, np.int64)
        self.patches = BirthPatches(window_px)
        self._ready_from: Ids = np.zeros(0, np.int64)
        self._new: list[tuple[Ids, BirthPatches, int]] = []  # not yet in the arrays, which are copied to grow

    def add(self, ids: Ids, patches: BirthPatches, ready_from: int) -> None:
        """Add tracks that may be revived from the frame `ready_from` on."""
        self._new.append((ids, patches, ready_from))

    def ready(self, frame: int) -> Ids:
        """Ids of the tracks that may be revived in a frame."""
        self._gather()
        return self.ids[self._ready_from <= frame]

    def holds(self, ids: Ids) -> NDArray[np.bool_]:
        """(n,) which of some tracks are remembered."""
        self._gather()
        return np.isin(ids, self.ids)

    def rows(self, ids: Ids) -> Rows:
        """The rows of some of the tracks."""
        order = np.argsort(self.ids)
        return np.asarray(order[np.searchsorted(self.ids, ids, sorter=order)])

    def remove(self, rows: Rows) -> None:
        """Remove the tracks in these rows."""
        rest = np.ones(len(self.ids), bool)
        rest[rows] = False
        self._keep(rest)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        self._gather()
        return {"ids": self.ids, "ready_from": self._ready_from, "patches": self.patches.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.ids, self._ready_from = state["ids"], state["ready_from"]
        self.patches.restore(state["patches"])

    def _gather(self) -> None:
        for ids, patches, ready_from in self._new:
            self.ids = np.r_[self.ids, ids]
            self._ready_from = np.r_[self._ready_from, np.full(len(ids), ready_from)]
            self.patches.append(patches)
        self._new.clear()
        if len(self.ids) > _MOST_ENDED:
            self._keep(slice(-_MOST_ENDED, None))

    def _keep(self, index: NDArray[np.bool_] | slice) -> None:
        self.ids = self.ids[index]
        self._ready_from = self._ready_from[index]
        self.patches.keep(index)
