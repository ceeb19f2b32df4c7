"""What the mapper of video and that of image sets have in common: the map, and the steps that extend it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.live_covariance import doubt
from factorsfm.mapping.map_copy import MapUpdate
from factorsfm.mapping.map_registration import NotOnMap, register_on_map
from factorsfm.mapping.mapped_images import MappedImage, refocus
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.registration import Registration
from factorsfm.mapping.starts import Start
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class IncrementalMapper:
    """A map of images and points that grows image by image.

    Args:
        focal: pixels; a guess where the options refine it.
        options: steps, thresholds and weights.

    Attributes:
        images: all images, registered or not; points: the map.
        focal: of the cameras of the images, their mean in pixels; first_focal: the one at the start.
    """

    def __init__(self, images: Sequence[MappedImage], focal: float, options: Options) -> None:
        self.options = options.mapper
        self.images = list(images)
        self.points = PointMap()
        self.focal, self.first_focal = focal, focal
        self._refine_focal = options.refine_focal_length

    @property
    def refines_focal(self) -> bool:
        """Whether the focal length is a guess, which the map refines."""
        return self._refine_focal

    @property
    def registered(self) -> int:
        """Number of images with a pose."""
        return sum(image.registered for image in self.images)

    def _register_near(self, image: MappedImage, near: MappedImage, *, in_order: bool) -> bool:
        """Register an image on the map from the pose of a registered one; whether that works.

        Args:
            in_order: whether `near` is its neighbour in time, see `register_on_map`.
        """
        found = register_on_map(image, self.points, near, self.focal, self.options, in_order=in_order)
        if isinstance(found, NotOnMap):
            image.status, image.message = found.status, found.message
            return False
        self._accept(image, found)
        return True

    def _accept(self, image: MappedImage, found: Registration) -> None:
        """Give an image its pose."""
        image.rotation, image.translation = found.rotation, found.translation
        image.inliers, image.threshold = int(found.inliers.sum()), found.threshold
        image.mapped = int(self.points.contains(image.tracks.ids).sum())
        image.status = FrameStatus.REGISTERED
        image.message = f"{image.inliers} inliers within {found.threshold:.1f} pixels"
        if found.affine is not None:
            image.affine = found.affine

    def _accept_start(self, start: Start) -> list[MappedImage]:
        """The points of a start become the map, and its images get their poses; returns these images in order."""
        self.points.set(start.ids, start.points)
        by_position = {image.tracks.position: image for image in self.images}
        images = [by_position[position] for position in start.images]
        for image, rotation, translation in zip(images, start.rotation, start.translation, strict=True):
            inliers = np.isin(image.tracks.ids, start.ids)
            pose = Registration(rotation, translation, inliers, 0.0, self.options.inlier_px, np.zeros((6, 6)))
            self._accept(image, pose)
        return images

    def _accept_update(self, update: MapUpdate) -> None:
        """The map as the graph sees it now: points, and poses and affines of the images that moved."""
        self.points.set(update.ids, update.points)
        self.points.remove(update.removed)
        for position, pose in update.poses.items():
            self.images[position].rotation, self.images[position].translation = pose
        for position, covariance in update.covariances.items():
            self.images[position].covariance = covariance + doubt(self.images[position], self.images)
        for position, affine in update.affines.items():
            self.images[position].affine = affine

    def explain(self, position: int, status: FrameStatus, message: str) -> None:
        """Say why an image is not registered, where that is known better than by its tracks; no word if it is."""
        image = self.images[position]
        if not image.registered:
            image.status, image.message = status, message

    def _set_focal(self, focal: float) -> None:
        """Go on with another focal length; what was seen stays as it is in pixels."""
        refocus(self.images, focal / self.focal)
        self.focal = focal
