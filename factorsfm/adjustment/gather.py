"""From the tracks of images to the observations of an adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.tracks.image_tracks import ImageTracks

Index = NDArray[np.int64]


def gather(images: Sequence[ImageTracks], ids: Index) -> Observations:
    """Observations of some tracks (ascending ids): frames and points are rows of `images` and `ids`."""
    last = max((int(t[-1]) for t in (ids, *(image.ids for image in images)) if len(t)), default=-1)
    row_of = np.full(last + 1, -1)
    row_of[ids] = np.arange(len(ids))
    frame, point, xy = [], [], []
    for row, image in enumerate(images):
        rows = row_of[image.ids]
        seen = rows >= 0
        point.append(rows[seen])
        frame.append(np.full(len(point[-1]), row))
        xy.append(image.xy[seen])
    order = np.argsort(np.concatenate(point), kind="stable")
    return Observations(np.concatenate(frame)[order], np.concatenate(point)[order], np.concatenate(xy)[order])
