"""Tracks that the user vouches for: placed by hand, or made by another program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEAST_SUPERVISED = 5  # of which a frame that nothing else joins to the others sees at least: a pose needs three


@dataclass(frozen=True, slots=True)
class SupervisedTracks:
    """Which tracks of some images are supervised.

    Attributes:
        ids: (n,) ascending.
        names: (n,) of the user.
        sigma: (n,) standard deviation of each coordinate of their places, pixels.
        join: whether only they join some images to the others, so that the cameras rest on them from the first.
    """

    ids: Index
    names: tuple[str, ...]
    sigma: Array
    join: bool = False

    @classmethod
    def none(cls) -> SupervisedTracks:
        """No track."""
        return cls(np.zeros(0, np.int64), (), np.zeros(0))

    def sigma_of(self, tracks: Index) -> Array:
        """(m,) standard deviations of some tracks, pixels; NaN of those that are not supervised."""
        found = np.full(len(tracks), np.nan)
        mine = np.isin(tracks, self.ids)
        found[mine] = self.sigma[np.searchsorted(self.ids, tracks[mine])]
        return found

    def of(self, ids: Index) -> SupervisedTracks:
        """Those among some tracks."""
        kept = np.flatnonzero(np.isin(self.ids, ids))
        names = tuple(self.names[k] for k in kept.tolist())
        return SupervisedTracks(self.ids[kept], names, self.sigma[kept], self.join)

    def names_of(self, tracks: Index) -> list[str]:
        """(m,) names of some tracks: those of the user, else `track_name`."""
        given = dict(zip(self.ids.tolist(), self.names, strict=True))
        return [given.get(track) or track_name(track) for track in tracks.tolist()]

    def without(self, ids: Index) -> SupervisedTracks:
        """Those that are not among some tracks."""
        return self.of(np.setdiff1d(self.ids, ids))


def track_name(track: int) -> str:
    """The name of a track, by its id, that has none of the user: with the number of its point in COLMAP's model."""
    return f"track_{track + 1:05d}"
