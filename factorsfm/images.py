"""Images as the mapper sees them: tracks instead of pixels, and what became of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.problem import Observations, State
from factorsfm.reconstruction import FrameStatus
from factorsfm.registration import ImageDepth

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


@dataclass(slots=True)
class MappedImage:
    """An image and what is known of its pose.

    Attributes:
        inliers: tracks that agree with its pose; threshold: reprojection error up to which they do (pixels).
        affine: scale and shift of its depth prior beside the map.
        covariance: (6, 6) of the pose as it was registered, or as the graph has it for a keyframe.
    """

    tracks: ImageTracks
    status: FrameStatus
    message: str
    rotation: Array | None = None
    translation: Array | None = None
    keyframe: bool = False
    inliers: int = 0
    threshold: float = 0.0
    affine: tuple[float, float] | None = None
    covariance: Array | None = None

    @property
    def registered(self) -> bool:
        return self.rotation is not None

    @property
    def pose(self) -> tuple[Array, Array]:
        """`cam_from_world` rotation and translation of a registered image."""
        if self.rotation is None or self.translation is None:
            raise ValueError(f"image {self.tracks.position} is not registered")
        return self.rotation, self.translation

    def forget(self, status: FrameStatus, message: str) -> None:
        """Give up all that is known but the tracks, and the prior at them."""
        blank = MappedImage(self.tracks, status, message)
        for field in fields(self):
            setattr(self, field.name, getattr(blank, field.name))


def seen_by(images: Sequence[MappedImage], least: int) -> Index:
    """Ids (ascending) of the tracks that at least so many of the images see."""
    ids, count = np.unique(np.concatenate([image.tracks.ids for image in images]), return_counts=True)
    return np.asarray(ids[count >= least])


def gather(images: Sequence[MappedImage], ids: Index) -> Observations:
    """Observations of some tracks (ascending ids): frames and points are rows of `images` and `ids`."""
    last = max((int(t[-1]) for t in (ids, *(image.tracks.ids for image in images)) if len(t)), default=-1)
    row_of = np.full(last + 1, -1)
    row_of[ids] = np.arange(len(ids))
    frame, point, xy = [], [], []
    for row, image in enumerate(images):
        rows = row_of[image.tracks.ids]
        seen = rows >= 0
        point.append(rows[seen])
        frame.append(np.full(len(point[-1]), row))
        xy.append(image.tracks.xy[seen])
    order = np.argsort(np.concatenate(point), kind="stable")
    return Observations(np.concatenate(frame)[order], np.concatenate(point)[order], np.concatenate(xy)[order])


def median_flow(a: ImageTracks, b: ImageTracks) -> float:
    """Median displacement of the shared tracks, normalised image coordinates; infinite without any."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return float(np.median(np.linalg.norm(a.xy[in_a] - b.xy[in_b], axis=1))) if len(in_a) else float("inf")


def shared_tracks(a: ImageTracks, b: ImageTracks) -> int:
    """How many tracks two images have in common."""
    return int(np.isin(a.ids, b.ids, assume_unique=True).sum())


def state_of(images: Sequence[MappedImage], points: Array, focal: float) -> State:
    """Poses of registered images, and Euclidean points (n, 3), as variables of a bundle adjustment."""
    distance = np.linalg.norm(points, axis=1)
    return State(
        np.array([image.rotation for image in images]),
        np.array([image.translation for image in images]),
        points / distance[:, None],
        1.0 / distance,
        np.log([focal]),
    )


def renormalize(images: Sequence[MappedImage], ratio: float) -> None:
    """What was seen with another focal length; `ratio`: the former one over the new one."""
    for image in images:
        image.tracks = replace(image.tracks, xy=image.tracks.xy * ratio)
