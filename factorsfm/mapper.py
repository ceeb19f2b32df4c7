"""The incremental mapper: start, register, triangulate, update the graph; one image at a time, in order of arrival."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph import FactorGraph, Keyframe
from factorsfm.guidance import DepthGuidance
from factorsfm.images import ImageTracks, MappedImage, gather, median_flow
from factorsfm.initialization import NoStart, Start, start_essential, start_lifted, start_pair
from factorsfm.options import Options
from factorsfm.point_map import PointMap
from factorsfm.reconstruction import FrameStatus
from factorsfm.registration import ImageDepth, Registration, register_image
from factorsfm.triangulation import triangulate

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_PAIR_WINDOW = 10  # images among which the paper's initial pair is sought
_LIFT_PATIENCE = 10  # images without a usable depth map after which the start does without


class Mapper:
    """Depth-guided incremental structure from motion over tracks.

    Args:
        focal: pixels; width: of the image, pixels.
        options: steps, thresholds and weights.
        has_prior: whether a depth prior exists at all; without one the start is the essential matrix.
    """

    def __init__(self, focal: float, width: int, options: Options, *, has_prior: bool) -> None:
        self.options = options.mapper
        self.focal = focal
        self.width = width
        self.images: list[MappedImage] = []
        self.graph = FactorGraph(focal, self.options.pixel_sigma)
        self._start_kind = self.options.initialization if has_prior else "essential"
        self._reads_every_depth = has_prior and (
            self._start_kind == "pair" or self.options.registration_depth != "none"
        )
        self._uses_keyframe_depth = has_prior and options.uses_depth
        self._started = False
        self.points = PointMap()
        self.guidance = DepthGuidance(self.options, self.points)
        self._waits_for_depth = 0

    # --- the algorithm ------------------------------------------------------------------------------------------

    def add(self, tracks: ImageTracks, read_depth: Callable[[], ImageDepth | None]) -> MappedImage:
        """Take the next image: register it on the map, and extend the map where it shows something new.

        Args:
            read_depth: gives the prior at the image's keypoints; called only if it is needed.
        """
        if self._reads_every_depth:
            tracks = replace(tracks, depth=read_depth())
        image = MappedImage(tracks, FrameStatus.WAITING, "waiting for the start of the map")
        self.images.append(image)
        try:
            self._process(image, read_depth)
        except Exception:  # a prior that fails, before anything changed: the image was never here
            self.images.pop()
            raise
        return image

    def _process(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None]) -> None:
        if len(image.tracks.ids) < self.options.min_tracks:
            image.status = FrameStatus.TOO_FEW_TRACKS
            image.message = f"{len(image.tracks.ids)} of {self.options.min_tracks} needed tracks"
        elif not self._started:
            self._try_start(image, read_depth)
        else:
            self._register(image)
            if image.registered and self._is_keyframe(image):
                self._add_keyframe(image, read_depth)

    def finish(self) -> None:
        """No more images: start with what there is, if nothing better came."""
        if not self._started and self._start_kind == "pair":
            self._begin(self._start_from_pair())
        if not self._started:
            self._begin(self._start_essential(angle_deg=0.0))
        if not self._started:
            self._begin(self._start_flat())

    # --- start --------------------------------------------------------------------------------------------------

    def _waiting(self) -> list[MappedImage]:
        return [image for image in self.images if image.status is FrameStatus.WAITING]

    def _try_start(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None]) -> None:
        if self._start_kind == "lifted":
            image.tracks = replace(image.tracks, depth=read_depth())
            start = start_lifted(image.tracks, self.options.min_tracks)
            if isinstance(start, NoStart) and len(self._waiting()) >= _LIFT_PATIENCE:
                logger.warning("no usable depth in %d images, starting without: %s", _LIFT_PATIENCE, start.reason)
                self._start_kind = "essential"
        elif self._start_kind == "pair":
            if len(self._waiting()) < _PAIR_WINDOW:
                image.message = f"{len(self._waiting())} of {_PAIR_WINDOW} images among which the start is chosen"
                return
            start = self._start_from_pair()
        else:
            start = self._start_essential(self.options.essential_angle_deg)
        self._begin(start)

    def _start_from_pair(self) -> Start | NoStart:
        o = self.options
        images = [image.tracks for image in self._waiting()]
        return start_pair(images, o.min_tracks, focal=self.focal, sigma=o.pixel_sigma, inlier_px=o.inlier_px)

    def _start_essential(self, angle_deg: float) -> Start | NoStart:
        """The first waiting image and the last one; with no angle asked for, the partner with most parallax."""
        o = self.options
        waiting = [image.tracks for image in self._waiting()]
        if len(waiting) < 2:
            return NoStart(f"{len(waiting)} of 2 needed images")
        first = waiting[0]
        partners = waiting[-1:] if angle_deg > 0.0 else sorted(waiting[1:], key=lambda t: -median_flow(first, t))[:5]
        start: Start | NoStart = NoStart("no partner")
        for second in partners:
            start = start_essential(
                first, second, o.min_tracks, focal=self.focal, sigma=o.pixel_sigma, angle_deg=angle_deg
            )
            if isinstance(start, Start):
                break
        return start

    def _start_flat(self) -> Start | NoStart:
        """All points at one depth: enough for the rotations of a shot that has no translation to offer."""
        if not self._waiting():
            return NoStart("no image with enough tracks")
        first = self._waiting()[0].tracks
        points = np.concatenate([first.xy, np.ones((len(first.xy), 1))], 1)
        return Start([first.position], [np.eye(3)], [np.zeros(3)], first.ids, points)

    def _begin(self, start: Start | NoStart) -> None:
        if isinstance(start, NoStart):
            for image in self._waiting():
                image.message = start.reason
            return
        self._started = True
        self.points.set(start.ids, start.points)
        waiting = self._waiting()
        for position, rotation, translation in zip(start.images, start.rotation, start.translation, strict=True):
            image = next(i for i in waiting if i.tracks.position == position)
            self._accept(image, Registration(rotation, translation, np.isin(image.tracks.ids, start.ids), 0.0, 0.0))
            self._add_keyframe(image, None)
        # Next image as COLMAP chooses it: the one that sees most of the map.
        remaining = [image for image in waiting if not image.registered]
        while remaining:
            image = max(remaining, key=lambda i: int(self.points.contains(i.tracks.ids).sum()))
            remaining.remove(image)
            self._register(image)
            if image.registered and self._is_keyframe(image):
                self._add_keyframe(image, None)

    # --- registration -------------------------------------------------------------------------------------------

    def _register(self, image: MappedImage) -> None:
        """PnP on the mapped tracks, then refinement with the depth prior where the options say so."""
        o = self.options
        tracks = image.tracks
        mapped = self.points.contains(tracks.ids)
        if mapped.sum() < o.min_inliers:
            image.status = FrameStatus.TOO_FEW_TRACKS
            image.message = f"{mapped.sum()} of {o.min_inliers} needed tracks have a point in the map"
            return
        near = self._nearest_registered(tracks.position)
        depth = None
        if o.registration_depth != "none" and tracks.depth is not None:
            depth = _select(tracks.depth, mapped)
        result = register_image(
            self.points.at(tracks.ids[mapped]),
            tracks.xy[mapped],
            *near.pose,
            focal=self.focal,
            sigma=o.pixel_sigma,
            inlier_px=o.inlier_px,
            depth=depth,
            domain="depth" if o.registration_depth == "paper" else "inverse",
            depth_weight=o.depth_weight,
        )
        found = int(result.inliers.sum())
        if found < o.min_inliers:
            image.status = FrameStatus.TOO_FEW_INLIERS
            image.message = f"{found} of {o.min_inliers} needed inliers among {mapped.sum()} mapped tracks"
            return
        inliers = np.zeros(len(tracks.ids), bool)
        inliers[np.nonzero(mapped)[0][result.inliers]] = True
        self._accept(image, replace(result, inliers=inliers))

    def _nearest_registered(self, position: int) -> MappedImage:
        for offset in range(1, len(self.images)):
            for other in (position - offset, position + offset):
                if 0 <= other < len(self.images) and self.images[other].registered:
                    return self.images[other]
        raise ValueError("no image is registered")

    def _accept(self, image: MappedImage, result: Registration) -> None:
        image.rotation, image.translation = result.rotation, result.translation
        image.inliers = int(result.inliers.sum())
        image.status = FrameStatus.REGISTERED
        image.message = f"{image.inliers} inliers within {result.threshold:.1f} pixels"
        if result.affine is not None:
            image.affine = result.affine

    # --- keyframes and landmarks --------------------------------------------------------------------------------

    def _is_keyframe(self, image: MappedImage) -> bool:
        last = self.images[self.graph.keyframes[-1]].tracks if self.graph.keyframes else None
        if last is None:
            return True
        shared = np.isin(image.tracks.ids, last.ids, assume_unique=True).sum()
        return (
            abs(image.tracks.position - last.position) >= self.options.keyframe_interval
            or shared < 0.7 * len(last.ids)
            or median_flow(image.tracks, last) * self.focal > self.options.keyframe_flow * self.width
        )

    def _add_keyframe(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None] | None) -> None:
        """Depth of the keyframe, new landmarks, update of the graph, and the map as the graph now sees it."""
        if self._uses_keyframe_depth and image.tracks.depth is None and read_depth is not None:
            image.tracks = replace(image.tracks, depth=read_depth())
            if image.tracks.depth is None and self._waits_for_depth < 3:
                self._waits_for_depth += 1  # the next image may have a map
                return
            self._waits_for_depth = 0
        tracks = image.tracks
        self.guidance.fit(image)
        known = np.isin(tracks.ids, self.graph.landmarks, assume_unique=True) & self._explained(image)
        new_ids, new_points = self._new_landmarks(image, known)
        used = known | np.isin(tracks.ids, new_ids, assume_unique=True)
        if used.sum() < self.options.min_inliers:
            return
        keyframe = Keyframe(
            tracks.position,
            *image.pose,
            tracks.ids[used],
            tracks.xy[used],
            self.guidance.measurements(image, used, len(self.graph.keyframes)),
        )
        earlier = []
        for position in self.graph.keyframes:
            before = self.images[position].tracks
            seen = np.isin(before.ids, new_ids, assume_unique=True)
            if seen.any():
                earlier.append((position, before.ids[seen], before.xy[seen]))
        result = self.graph.update(keyframe, new_ids, new_points, earlier)
        if not result.committed:
            return
        image.keyframe = True
        self.points.set(*self.graph.points())
        for position, (rotation, translation) in self.graph.poses().items():
            self.images[position].rotation, self.images[position].translation = rotation, translation
        image.affine = self.graph.affine(tracks.position) or image.affine
        # Only what is grossly wrong: a young map is, too, and long tracks are precious.
        gross = self.points.contains(tracks.ids) & ~self._explained(image, leniency=4.0)
        image.outliers = tracks.ids[gross]

    def _explained(self, image: MappedImage, leniency: float = 1.0) -> NDArray[np.bool_]:
        """Which tracks have a point that projects where it was seen, within the widened inlier threshold."""
        mapped = self.points.contains(image.tracks.ids)
        error = self.points.reprojection_errors(image, mapped) * self.focal
        limit = max(self.options.inlier_px, 5.0 * float(np.median(error)) if len(error) else 0.0)
        explained = mapped.copy()
        explained[mapped] = error < leniency * limit
        return explained

    def _new_landmarks(self, image: MappedImage, known: NDArray[np.bool_]) -> tuple[Index, Array]:
        """Tracks that become landmarks: well spread, triangulated from the keyframes that see them."""
        o = self.options
        room = o.landmarks - int(known.sum())
        candidates = ~np.isin(image.tracks.ids, self.graph.landmarks, assume_unique=True)
        keyframes = [self.images[k] for k in self.graph.keyframes] + [image]
        if len(keyframes) == 1:  # the start: its points are there already
            candidates &= self.points.contains(image.tracks.ids)
        else:
            seen = np.concatenate([k.tracks.ids for k in keyframes[:-1]])
            candidates &= np.isin(image.tracks.ids, seen)
        if room < o.landmarks // 10 or not candidates.any():
            return np.zeros(0, np.int64), np.zeros((0, 3))
        chosen = _spread(image.tracks.xy, known, np.nonzero(candidates)[0], room)
        ids = np.sort(image.tracks.ids[chosen])
        if len(keyframes) == 1:
            return ids, self.points.at(ids)
        return self._triangulate(keyframes, ids)

    def _triangulate(self, keyframes: list[MappedImage], ids: Index) -> tuple[Index, Array]:
        o = self.options
        rotation = np.array([k.rotation for k in keyframes])
        translation = np.array([k.translation for k in keyframes])
        affine, prior = self.guidance.at_observations(keyframes, ids)
        result = triangulate(
            rotation, translation, gather(keyframes, ids), focal=self.focal, inlier_px=o.inlier_px, sigma=o.pixel_sigma,
            fallback=self.guidance.fallback(keyframes[-1], ids), affine=affine, prior=prior,
        )  # fmt: skip
        good = (result.inliers >= 2) & (result.inverse_distance > 1e-6)
        return ids[good], result.bearing[good] / result.inverse_distance[good, None]


def _select(depth: ImageDepth, index: NDArray[np.bool_]) -> ImageDepth:
    return replace(depth, inverse_depth=depth.inverse_depth[index], reliability=depth.reliability[index])


def _spread(xy: Array, taken: NDArray[np.bool_], candidates: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """`count` of the candidates, taken in turn from the emptiest cells of a grid; older tracks come first."""
    cell = np.floor((xy - xy.min(0)) / np.maximum(np.ptp(xy, axis=0), 1e-9) * [15.99, 8.99]).astype(int)
    key = cell[:, 0] * 9 + cell[:, 1]
    load = np.bincount(key[taken], minlength=144)
    order = candidates[np.argsort(key[candidates], kind="stable")]
    first = np.searchsorted(key[order], np.arange(144))
    rank = np.arange(len(order)) - first[key[order]] + load[key[order]]
    return np.asarray(order[np.argsort(rank, kind="stable")[:count]])
