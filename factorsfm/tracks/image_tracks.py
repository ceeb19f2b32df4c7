"""The tracks that one image sees, and the depth prior at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.priors.image_depth import ImageDepth

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class ImageTracks:
    """The measurements of one image: its tracks, and the depth prior at them where it has one.

    Attributes:
        position: index among the images seen.
        ids: (n,) identities of the tracks, ascending.
        pixels: (n, 2) keypoints, in pixels of the camera with centres at integers.
        camera: of the image; another focal length is another camera, the pixels stay.
        depth: prior at the n keypoints.
        index: of the frame in its source, which names its variables in the graph; None: the position.
    """

    position: int
    ids: Index
    pixels: Array
    camera: pycolmap.Camera
    depth: ImageDepth | None = None
    index: int | None = None

    @property
    def frame(self) -> int:
        """Index of the frame in its source."""
        return self.position if self.index is None else self.index

    @cached_property
    def xy(self) -> Array:
        """(n, 2) undistorted normalised image coordinates; NaN where the lens model cannot be inverted."""
        return normalized_from_pixels(self.camera, self.pixels)

    @property
    def invertible(self) -> NDArray[np.bool_]:
        """(n,) keypoints that the camera has a ray for: a distortion model may have no inverse in the corners."""
        return np.asarray(np.isfinite(self.xy).all(axis=1))

    def joined(self, ids: NDArray[np.int64], pixels: Array) -> ImageTracks:
        """With further tracks behind the others, of which the prior says nothing."""
        depth = self.depth.padded(len(ids)) if self.depth is not None else None
        return replace(self, ids=np.r_[self.ids, ids], pixels=np.r_[self.pixels, pixels], depth=depth)

    def of(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> ImageTracks:
        """Some of the n tracks, or all in another order."""
        depth = self.depth.of(kept) if self.depth is not None else None
        return replace(self, ids=self.ids[kept], pixels=self.pixels[kept], depth=depth)


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
