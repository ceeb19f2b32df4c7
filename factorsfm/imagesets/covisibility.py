"""Which images of a set see the same tracks, and how well the mapped ones are spread over an image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FINEST_CELLS = 32  # across the image, of the pyramid


def common_tracks(tracks: Sequence[ImageTracks]) -> Index:
    """(n, n) number of tracks that two images have in common, 0 on the diagonal."""
    n = len(tracks)
    ids = np.concatenate([t.ids for t in tracks])
    image = np.repeat(np.arange(n), [len(t.ids) for t in tracks])
    order = np.argsort(ids, kind="stable")
    ids, image = ids[order], image[order]
    common = np.zeros((n, n), np.int64)
    for step in range(1, n):
        same = ids[step:] == ids[:-step]
        if not same.any():
            break
        np.add.at(common, (image[:-step][same], image[step:][same]), 1)
    return common + common.T


def track_lengths(tracks: Sequence[ImageTracks]) -> Index:
    """By track id, in how many of the images it is seen."""
    return np.bincount(np.concatenate([t.ids for t in tracks]))


def longest_tracks(tracks: Sequence[ImageTracks], count: int) -> Index:
    """Ids (ascending) of the tracks that are among the `count` longest ones of an image."""
    length = track_lengths(tracks)
    chosen = [t.ids[np.argsort(-length[t.ids], kind="stable")[:count]] for t in tracks]
    return np.unique(np.concatenate(chosen))


def pyramid_score(xy: Array, mapped: NDArray[np.bool_]) -> int:
    """Number of mapped keypoints and their spread: occupied cells at several resolutions, fine ones counting more.

    Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.2.
    """
    low, extent = xy.min(0), np.maximum(np.ptp(xy, axis=0), 1e-9)
    place = np.clip((xy[mapped] - low) / extent, 0.0, 1.0 - 1e-9)
    occupied: NDArray[np.bool_] = np.zeros((_FINEST_CELLS, _FINEST_CELLS), bool)
    occupied[tuple((place * _FINEST_CELLS).astype(np.int64).T)] = True
    score = 0
    while (cells := len(occupied)) > 1:
        score += cells * int(occupied.sum())
        occupied = np.asarray(occupied.reshape(cells // 2, 2, cells // 2, 2).any(axis=(1, 3)))
    return score
