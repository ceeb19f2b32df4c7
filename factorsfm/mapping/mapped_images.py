"""Images as the mapper sees them: tracks instead of pixels, and what became of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.state import State
from factorsfm.camera.projection import with_focal
from factorsfm.support.similarity import covariance_in_unit
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(slots=True)
class MappedImage:
    """An image and what is known of its pose.

    Attributes:
        inliers: tracks that agree with its pose, of the `mapped` ones, which had a point when it was registered;
            threshold: reprojection error up to which they do (pixels).
        rough: whether it fits far worse than the images before it, see `suddenly_rough`.
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
    mapped: int = 0
    threshold: float = 0.0
    rough: bool = False
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

    def scale(self, unit: float) -> None:
        """Go on in a world where all lengths are `unit` times as long; nothing is changed in place."""
        if self.translation is not None:
            self.translation = unit * self.translation
        if self.affine is not None:
            self.affine = unit * self.affine[0], self.affine[1]
        if self.covariance is not None:
            self.covariance = covariance_in_unit(self.covariance, unit)

    def take_up_tracks(self, ids: Index, pixels: Array) -> None:
        """Observe further tracks.

        Args:
            ids: (n,) tracks; pixels: (n, 2) where they are.
        """
        joined = self.tracks.joined(ids, pixels)
        self.tracks = joined.of(np.argsort(joined.ids))

    def forget_tracks(self, ids: Index) -> None:
        """Leave some tracks out."""
        keep = ~np.isin(self.tracks.ids, ids)
        if not keep.all():
            self.tracks = self.tracks.of(keep)


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


def nearest_registered(images: Sequence[MappedImage], position: int) -> MappedImage:
    """The registered image nearest to a position in a shot."""
    for offset in range(1, len(images)):
        for other in (position - offset, position + offset):
            if 0 <= other < len(images) and images[other].registered:
                return images[other]
    raise ValueError("no image is registered")


def refocus(images: Sequence[MappedImage], ratio: float) -> None:
    """Give the images, which may share cameras, `ratio` times their present focal lengths."""
    cameras = {id(image.tracks.camera): image.tracks.camera for image in images}
    refocused = {key: with_focal(camera, ratio * camera.mean_focal_length()) for key, camera in cameras.items()}
    for image in images:
        image.tracks = replace(image.tracks, camera=refocused[id(image.tracks.camera)])
