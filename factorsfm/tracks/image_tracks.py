"""The tracks that one image sees, and the depth prior at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.priors.image_depth import ImageDepth

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ImageTracks:
    """What the mapper knows of an image: its tracks, and the depth prior at them where it has one.

    Attributes:
        position: index among the frames seen.
        ids: (n,) identities of the tracks, ascending.
        xy: (n, 2) undistorted normalised image coordinates.
        depth: prior at the n keypoints.
    """

    position: int
    ids: Index
    xy: Array
    depth: ImageDepth | None = None

    def joined(self, ids: NDArray[np.int64], xy: Array) -> ImageTracks:
        """With further tracks behind the others, of which the prior says nothing."""
        depth = self.depth.padded(len(ids)) if self.depth is not None else None
        return ImageTracks(self.position, np.r_[self.ids, ids], np.r_[self.xy, xy], depth)

    def of(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> ImageTracks:
        """Some of the n tracks, or all in another order."""
        depth = self.depth.of(kept) if self.depth is not None else None
        return ImageTracks(self.position, self.ids[kept], self.xy[kept], depth)


def seen_by(images: Sequence[ImageTracks], least: int) -> Index:
    """Ids (ascending) of the tracks that at least so many of the images see."""
    ids, count = np.unique(np.concatenate([image.ids for image in images]), return_counts=True)
    return np.asarray(ids[count >= least])


def median_flow(a: ImageTracks, b: ImageTracks) -> float:
    """Median displacement of the shared tracks, normalised image coordinates; infinite without any."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return float(np.median(np.linalg.norm(a.xy[in_a] - b.xy[in_b], axis=1))) if len(in_a) else float("inf")


def shared_tracks(a: ImageTracks, b: ImageTracks) -> int:
    """How many tracks two images have in common."""
    return int(np.isin(a.ids, b.ids, assume_unique=True).sum())
