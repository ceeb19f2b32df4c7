"""The incremental mapper for unordered images: start, next best image, triangulate, update the graph.

The steps and the graph are those of `mapping.mapper`; what differs is the order, which is chosen, and with it the
window of the graph. All images are adjusted together, on their best tracks, while the map does not fit yet or its focal
length is open, and then whenever it has grown by a lot.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.imagesets.covisibility import common_tracks, longest_tracks, pyramid_score, track_lengths
from factorsfm.imagesets.set_update import update_set
from factorsfm.imagesets.start import median_angle, possible_starts
from factorsfm.mapping.depth_guidance import DepthGuidance
from factorsfm.mapping.incremental import IncrementalMapper
from factorsfm.mapping.landmarks import triangulate_tracks
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.mapped_images import MappedImage, state_of
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.registration import Registration
from factorsfm.mapping.starts import NoStart, Start
from factorsfm.support.components import connected_components
from factorsfm.support.options import Options
from factorsfm.support.parallax import parallax
from factorsfm.support.rotations import camera_centers
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_LEAST_ANGLE_DEG = 1.5  # between the rays of a new point; less where those of the whole map are small
_LEAST_ANGLE_SHARE = 0.3  # of the median angle of the map
_WORKING_TRACKS = (150, 1000, 60_000)  # per image while the map grows: at least, at most, and in the whole set
_LEAST_FITTING, _MOST_CONTRADICTED = 0.5, 0.25  # shares of an image's observations, and of the images
_GROWTH = 0.1  # of the number of images after which all are adjusted, until the map fits
_SETTLED_GROWTH = 1.0  # the same for a map that fits
_SETTLED_SIGMAS = 2.0  # largest median error in a map that fits, in standard deviations of an observation
_SETTLED_FOCAL = 0.01  # last relative change of a focal length that is known well enough
_GOOD_PX = 4.0  # reprojection error of a good observation
_FOCAL_IMAGES, _FOCAL_ANGLE_DEG = 4, 3.0  # from which a guessed focal length is refined with the map


class SetMapper(IncrementalMapper):
    """Depth-guided incremental structure from motion over the tracks of an unordered set.

    Args:
        tracks: of all images, with the depth prior where there is one.
        focal: pixels; a guess that is refined with the map where the options say so.
        options: steps, thresholds and weights.

    Attributes:
        images: what became of each image; points: the map.
        focal: as the tracks of `images` are normalised with it; first_focal: what was thought of it at first.
    """

    def __init__(self, tracks: list[ImageTracks], focal: float, options: Options) -> None:
        waiting = [MappedImage(t, FrameStatus.WAITING, "waiting for the start of the map") for t in tracks]
        super().__init__(waiting, focal, options)
        self._adjustment = replace(options.polish, iterations=10, tolerance=1e-3)
        self._common = common_tracks(tracks)
        self._order: list[MappedImage] = []  # of registration; the first one is the world
        self._adjusted = 0
        self._graph = KeyframeGraph()
        self._fits = False  # whether all images that the last adjustment or update was about agree with the map
        self._focal_change = np.inf  # relative, when it was refined last
        self._tried: dict[int, int] = {}  # by position: mapped tracks with which an image was tried last
        self._scores: dict[int, tuple[int, int]] = {}  # by position: mapped tracks, and their score
        self._released: set[int] = set()  # positions of images that were taken out of the map again, once each
        self._held: set[int] = set()  # positions of the images whose poses are given
        self._angle = 0.0  # median angle between the rays of the latest points, degrees

    @property
    def parallax(self) -> float:
        """Of the registered images: largest distance from the first one over the median distance of the points."""
        centers = camera_centers(*(np.array(part) for part in zip(*(image.pose for image in self._order), strict=True)))
        return parallax(centers, 1.0 / np.linalg.norm(self.points.all()[1] - centers[0], axis=1))

    # --- the algorithm ------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Register all images that can be."""
        usable = self._usable()
        best: list[MappedImage] = []
        best_points = self.points
        tracks = [self.images[k].tracks for k in usable]
        starts = possible_starts(tracks, self._common[np.ix_(usable, usable)], self.options, self.focal)
        if isinstance(starts, NoStart):
            for k in usable:
                self.images[k].message = starts.reason
            return
        least, most, total = _WORKING_TRACKS
        working = longest_tracks(tracks, int(np.clip(total // len(tracks), least, most)))
        for start in starts:
            self._begin(start)
            self._grow(working)
            if len(self._order) > len(best):
                best, best_points = [replace(image) for image in self._order], self.points
            if len(best) > len(usable) // 2:
                break
        for image in best:  # the tracks as they are normalised now
            self.images[image.tracks.position] = replace(image, tracks=self.images[image.tracks.position].tracks)
        self._order = [self.images[image.tracks.position] for image in best]
        self.points = best_points
        if self._order:
            self._grow(None)
            self._say_what_is_missing()

    def extend(self, known: dict[int, tuple[Array, Array]]) -> None:
        """Register all images that can be on those whose poses are known, which stay as they are.

        Args:
            known: `cam_from_world` rotation and translation by position, the first one near the origin of a world with
                a median distance of about 1.
        """
        for position, (rotation, translation) in known.items():
            image = self.images[position]
            nothing = np.zeros(len(image.tracks.ids), bool)
            given = Registration(rotation, translation, nothing, 0.0, self.options.inlier_px, np.zeros((6, 6)))
            self._accept(image, given)
        self._held = set(known)
        self._grow(None)
        self._say_what_is_missing()

    def _say_what_is_missing(self) -> None:
        for image in self.images:
            if image.status is FrameStatus.WAITING:
                mapped = int(self.points.contains(image.tracks.ids).sum())
                image.status = FrameStatus.LOST
                image.message = f"{mapped} of {self.options.min_inliers} needed tracks have a point in the map"

    def _usable(self) -> list[int]:
        """The images of the largest component; the others learn why they are left out."""
        o = self.options
        component = connected_components(len(self._common), np.argwhere(self._common >= o.min_inliers))
        size = Counter(component.tolist())
        largest = max(size, key=lambda c: size[c])
        for image, c in zip(self.images, component.tolist(), strict=True):
            tracks = len(image.tracks.ids)
            image.status = FrameStatus.TOO_FEW_TRACKS
            if size[c] == 1:
                most = int(self._common[image.tracks.position].max(initial=0))
                image.message = (
                    f"{most} of {o.min_inliers} needed tracks in common with any other image, {tracks} in all"
                )
            elif c != largest:
                others = int(self._common[image.tracks.position][component == largest].max(initial=0))
                image.message = (
                    f"belongs to a part of {size[c]} images; with the largest part, of {size[largest]} images, it has "
                    f"{others} of {o.min_inliers} needed tracks in common"
                )
            elif tracks < o.min_tracks:
                image.message = f"{tracks} of {o.min_tracks} needed tracks"
            else:
                image.status, image.message = FrameStatus.WAITING, "waiting for the start of the map"
        return [k for k, image in enumerate(self.images) if image.status is FrameStatus.WAITING]

    def _grow(self, working: Index | None) -> None:
        """Register one image after the other, on some of the tracks (ascending ids) or on all."""
        self._extend(working)
        self._adjust()
        self._tried.clear()
        while True:
            while (image := self._next()) is not None:
                if self._register(image):
                    self._extend(working, image)
                    self._take_in(working)
            if len(self._order) == self._adjusted:
                return
            self._adjust()  # images that it releases come next
            self._extend(working)

    def _take_in(self, working: Index | None) -> None:
        """Solve for the newest image and those around it, or for all where that is not enough."""
        growth = len(self._order) / self._adjusted - 1.0
        if self._is_settled() and growth < _SETTLED_GROWTH:
            self._update()
        if growth >= (_SETTLED_GROWTH if self._is_settled() else _GROWTH):
            self._adjust()
            self._extend(working)

    def _is_settled(self) -> bool:
        """Whether the map fits as well as it can with few images of it solved for at a time."""
        return self._fits and (not self._focal_is_open() or self._focal_change < _SETTLED_FOCAL)

    def _focal_is_open(self) -> bool:
        """Whether the focal length is a guess that the map can refine."""
        return self._refine_focal and len(self._order) >= _FOCAL_IMAGES and self._angle > _FOCAL_ANGLE_DEG

    def _begin(self, start: Start) -> None:
        for image in self._order:
            image.rotation = image.translation = None
        self.points, self._order, self._adjusted = PointMap(), [], 0
        self._fits, self._focal_change = False, np.inf
        self._released.clear()
        self._angle = median_angle(start)
        self._accept_start(start)

    # --- registration -------------------------------------------------------------------------------------------

    def _next(self) -> MappedImage | None:
        """The image with most and best spread mapped tracks; one that failed waits until it sees more of the map."""
        best, best_score = None, 0
        for image in self.images:
            if image.registered or image.status is FrameStatus.TOO_FEW_TRACKS:
                continue
            position, mapped = image.tracks.position, self.points.contains(image.tracks.ids)
            n = int(mapped.sum())
            if n < self.options.min_inliers or n < 1.2 * self._tried.get(position, 0):
                continue
            if self._scores.get(position, (0, 0))[0] != n:  # the same where the map has not grown in its sight
                self._scores[position] = n, pyramid_score(image.tracks.xy, mapped)
            if self._scores[position][1] > best_score:
                best, best_score = image, self._scores[position][1]
        if best is not None:
            self._tried[best.tracks.position] = self._scores[best.tracks.position][0]
        return best

    def _register(self, image: MappedImage) -> bool:
        """Register an image from the pose of the one that shares most tracks with it."""
        position = image.tracks.position
        near = max(self._order, key=lambda i: int(self._common[i.tracks.position, position]))
        done = self._register_near(image, near, in_order=False)
        logger.debug("image %d: %s", position, image.message)
        return done

    def _accept(self, image: MappedImage, found: Registration) -> None:
        super()._accept(image, found)
        image.keyframe = True
        self._order.append(image)

    # --- points -------------------------------------------------------------------------------------------------

    def _extend(self, working: Index | None, image: MappedImage | None = None) -> None:
        """Triangulate what has no point yet: of the working tracks, of one image or of all."""
        order = self._order
        if image is not None:  # a map of any size costs no more than what the image has to do with
            position = image.tracks.position
            order = [i for i in order if i is image or self._common[position, i.tracks.position] > 0]
        seen = track_lengths([i.tracks for i in order]) >= 2
        ids = np.nonzero(seen)[0] if image is None else image.tracks.ids[seen[image.tracks.ids]]
        if working is not None:
            ids = ids[np.isin(ids, working, assume_unique=True)]
        ids = ids[~self.points.contains(ids)]
        if not len(ids):
            return
        found = triangulate_tracks(
            order, ids, self._guidance(order), focal=self.focal, inlier_px=_GOOD_PX, fallback=np.full(len(ids), 1e-3)
        )
        angle = np.degrees(found.angle)
        good = (found.inliers >= 2) & (found.inverse_distance > 1e-6)
        if good.any():
            self._angle = float(np.median(angle[good]))
        good &= angle > min(_LEAST_ANGLE_DEG, _LEAST_ANGLE_SHARE * self._angle)
        self.points.set(ids[good], found.points(good))

    def _guidance(self, images: Sequence[MappedImage]) -> DepthGuidance:
        """The depth prior beside the map, fitted for each of these images where the options ask for it."""
        guidance = DepthGuidance(self.options, self.points)
        if self.options.triangulation_depth != "none":
            for image in images:
                guidance.fit(image)
        return guidance

    def _update(self) -> None:
        """Update the graph with the newest image; what does not fit then is left to the adjustment of all images."""
        position = np.array([image.tracks.position for image in self._order])
        copy = MapCopy(self._order, self.points, self.options, self.focal)
        shared, held = self._common[position[-1], position], np.isin(position, list(self._held))
        update, error = update_set(copy, self._graph, shared, held)
        self._fits = error < _SETTLED_SIGMAS * self.options.pixel_sigma
        if self._fits:
            self._accept_update(update)
        logger.debug("image %d: graph %s, median error of the worst image %.2f px", position[-1], update.reason, error)

    def _adjust(self) -> None:
        """Bundle adjustment of all registered images; points without two good observations are forgotten."""
        ids, points = self.points.all()
        length = track_lengths([i.tracks for i in self._order])
        kept = ids < len(length)
        kept[kept] = length[ids[kept]] >= 2
        ids, points = ids[kept], points[kept]
        observations = gather([image.tracks for image in self._order], ids, self.focal)
        state = state_of(self._order, points, self.focal)
        errors = BundleAdjustment(state, observations, self._adjustment, ErrorModel(1.0)).reprojection_errors()
        sigma = max(float(np.median(errors)), self.options.pixel_sigma)
        free_focal = self._focal_is_open()
        held = np.array([image.tracks.position in self._held for image in self._order]) if self._held else None
        adjustment = BundleAdjustment(
            state, observations, self._adjustment, ErrorModel(sigma), free=Free(focal=free_focal, held=held)
        )
        state = adjustment.solve()
        focal = float(np.exp(state.log_focal[0]))
        self._focal_change = abs(focal / self.focal - 1.0) if free_focal else np.inf
        if free_focal and 0.3 < focal / self.first_focal < 3.0:
            self._set_focal(focal)
        errors = adjustment.reprojection_errors()
        self._fits = float(np.median(errors)) < _SETTLED_SIGMAS * self.options.pixel_sigma
        self._graph = KeyframeGraph()  # from the map as it is now
        logger.debug(
            "adjusted %d images, %d points, %d observations to %.2f px in %d iterations",
            len(self._order), len(ids), len(errors), np.median(errors), adjustment.iterations,
        )  # fmt: skip
        for k, image in enumerate(self._order):
            image.rotation, image.translation = state.rotation[k], state.translation[k]
        fits = errors < _GOOD_PX
        wrong = self._contradicted(observations.frame, fits)
        supported = np.bincount(observations.point, fits & ~wrong[observations.frame], len(ids)) >= 2
        good = supported & (state.inverse_distance > 1e-6)
        self.points = PointMap()
        self.points.set(ids[good], state.points[good])
        for image in (image for image, released in zip(self._order, wrong, strict=True) if released):
            logger.debug("image %d is released: most of the map contradicts it", image.tracks.position)
            image.forget(FrameStatus.WAITING, "most of the map contradicts its pose")
            self._released.add(image.tracks.position)
            self._tried.pop(image.tracks.position, None)
        self._order = [image for image in self._order if image.registered]
        self._adjusted = len(self._order)

    def _contradicted(self, frame: Index, fits: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(k,) images of which few observations fit, where nearly all others agree: a start before a plane makes such.

        They are registered once more, on the map that the others have made.
        """
        count = len(self._order)
        share = np.bincount(frame, fits, count) / np.maximum(np.bincount(frame, minlength=count), 1)
        settled = self._held | self._released
        free = np.array([image.tracks.position not in settled for image in self._order])
        wrong = (share < _LEAST_FITTING) & free
        return wrong if wrong.sum() <= _MOST_CONTRADICTED * count else np.zeros(count, bool)
