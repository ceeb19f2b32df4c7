"""The tracks that the report lists one by one: those with the largest errors, and those of the user."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.result.reconstruction import Reconstruction
from factorsfm.tracks.supervised import SupervisedTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MOST = 200  # of the largest errors: more than anybody looks at


@dataclass(frozen=True, slots=True)
class ListedTracks:
    """n tracks, the one with the largest error first.

    Attributes:
        point: (n,) rows in `Reconstruction.points`.
        error: (n,) root of the mean squared reprojection error, pixels.
        worst, first, last: (n,) positions of the frame with the largest error, and of the first and last one.
        frames: (n,) how many registered frames see it.
        supervised: (n,) whether the user vouches for it.
    """

    point: Index
    error: Array
    worst: Index
    first: Index
    last: Index
    frames: Index
    supervised: NDArray[np.bool_]


def listed_tracks(reconstruction: Reconstruction) -> ListedTracks:
    """The tracks to list, of those that registered frames see."""
    r = reconstruction
    registered = np.array([frame.registered for frame in r.frames], bool)
    finite = np.asarray(np.isfinite(r.points).all(axis=1))[r.observation_point] & np.isfinite(r.observation_error)
    seen = np.flatnonzero(registered[r.observation_frame] & finite)
    seen = seen[np.lexsort((r.observation_frame[seen], r.observation_point[seen]))]
    frame, error = r.observation_frame[seen], r.observation_error[seen]
    point, start, frames = np.unique(r.observation_point[seen], return_index=True, return_counts=True)
    typical = np.sqrt(np.add.reduceat(error**2, start) / frames) if len(point) else np.zeros(0)
    by_error = np.lexsort((error, r.observation_point[seen]))  # the last of each point is its worst
    named = r.measured.supervised if r.measured is not None else SupervisedTracks.none()
    supervised = np.isin(r.track_ids[point], named.ids)
    order = np.argsort(-typical, kind="stable")
    order = order[(np.arange(len(order)) < _MOST) | supervised[order]]
    end = start + frames - 1
    return ListedTracks(
        point[order], typical[order], frame[by_error[end[order]]], frame[start[order]], frame[end[order]],
        frames[order], supervised[order],
    )  # fmt: skip
