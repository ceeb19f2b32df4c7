"""From the tracks of images to the observations of an adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def sightings(images: Sequence[ImageTracks], ids: Index) -> tuple[Index, Index, Index]:
    """Where some tracks (ascending ids) are seen, sorted by track.

    Returns:
        (m,) rows of `images`, (m,) rows of `ids`, and (m,) rows of the tracks of all images, one after the other.
    """
    last = max((int(t[-1]) for t in (ids, *(image.ids for image in images)) if len(t)), default=-1)
    row_of = np.full(last + 1, -1)
    row_of[ids] = np.arange(len(ids))
    point = np.concatenate([row_of[image.ids] for image in images])
    frame = np.repeat(np.arange(len(images)), [len(image.ids) for image in images])
    seen = np.nonzero(point >= 0)[0]
    at = seen[np.argsort(point[seen], kind="stable")]
    return frame[at], point[at], at


def gather(images: Sequence[ImageTracks], ids: Index, focal: Array | float) -> Observations:
    """Observations of some tracks (ascending ids): frames and points are rows of `images` and `ids`.

    Args:
        focal: of the cameras whose pixels are wanted, one or one for each image; the images' own may be of other sizes.
    """
    frame, point, at = sightings(images, ids)
    xy = np.concatenate([image.xy for image in images])[at]
    return Observations(frame, point, xy * np.broadcast_to(focal, len(images))[frame, None])
