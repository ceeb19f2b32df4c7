"""Finding a lost view again: descriptors of what the keyframes saw, compared with those of a new image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.grey import at_scale, reduced_image

Index = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

_PATCH_PX = 31  # side of the patch that a descriptor describes, in an image of the size in which motion is sought
_SCALES = (1.0, 0.7, 1.4)  # of the new image against a keyframe
_RATIO = 0.8  # largest distance of the best match against the second best
_LEAST_MATCHES = 12
_VIEWS_PER_IMAGE = 8  # keyframes compared with one image; the next image is compared with the next ones


@dataclass(frozen=True, slots=True)
class KeyframeView:
    """What a keyframe saw: its tracks and their descriptors; `position` of its image."""

    position: int
    ids: Index
    descriptors: Descriptors


class Relocalizer:
    """Remembers keyframes, and names their tracks in other images."""

    def __init__(self, views: Sequence[KeyframeView] = (), next_view: int = 0) -> None:
        self.views = list(views)
        self.next_view = next_view  # with which the next image is compared first

    def remember(self, position: int, grey: NDArray[np.uint8], ids: Index, xy: NDArray[np.float64]) -> None:
        """Keep a keyframe: position and (h, w) image, its track ids and their positions (n, 2) in pixels."""
        reduced, scale = reduced_image(grey)
        kept, descriptors = _describe(reduced, at_scale(xy, scale))
        self.views.append(KeyframeView(position, ids[kept], descriptors))

    def keep(self, views: Sequence[KeyframeView]) -> None:
        """Forget all other views."""
        self.views, self.next_view = list(views), 0

    def find(self, grey: NDArray[np.uint8], xy: NDArray[np.float64]) -> tuple[Index, NDArray[np.intp]]:
        """Remembered tracks among the corners of an image.

        Returns:
            Track ids (m,) and the rows of `xy` that look like them, for the keyframe with most of them; empty if none
            has enough. Up to half of them may be wrong.
        """
        best = np.zeros(0, np.int64), np.zeros(0, np.intp)
        if not self.views or not len(xy):
            return best
        reduced, scale = reduced_image(grey)
        xy = at_scale(xy, scale)
        described = [
            _describe(cv2.resize(reduced, None, fx=s, fy=s, interpolation=cv2.INTER_AREA), xy * s) for s in _SCALES
        ]
        for step in range(min(_VIEWS_PER_IMAGE, len(self.views))):
            view = self.views[(self.next_view + step) % len(self.views)]
            for rows, descriptors in described:
                mine, theirs = _matches(descriptors, view.descriptors)
                if len(mine) > max(len(best[0]), _LEAST_MATCHES - 1):
                    best = view.ids[theirs], rows[mine]
        if not len(best[0]):
            self.next_view = (self.next_view + _VIEWS_PER_IMAGE) % len(self.views)
        return best


def _describe(grey: NDArray[np.uint8], xy: NDArray[np.float64]) -> tuple[NDArray[np.intp], Descriptors]:
    """Upright binary descriptors of points (pixels), and the rows that have one: not too near to the border."""
    points = [cv2.KeyPoint(float(x), float(y), _PATCH_PX, 0.0, 0.0, 0, row) for row, (x, y) in enumerate(xy)]
    kept, descriptors = cv2.ORB.create(edgeThreshold=_PATCH_PX // 2, patchSize=_PATCH_PX).compute(grey, points)
    if descriptors is None:
        return np.zeros(0, np.intp), np.zeros((0, 32), np.uint8)
    return np.array([point.class_id for point in kept], np.intp), np.asarray(descriptors, np.uint8)


def _matches(a: Descriptors, b: Descriptors) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows that are each other's best and clearly better than the second best."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    matcher = cv2.BFMatcher.create(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(a, b, k=2)
    good = [first for first, second in forward if first.distance < _RATIO * second.distance]
    mine = np.array([match.queryIdx for match in good], np.intp)
    theirs = np.array([match.trainIdx for match in good], np.intp)
    _, unique, count = np.unique(theirs, return_index=True, return_counts=True)
    single = unique[count == 1]
    return mine[single], theirs[single]
