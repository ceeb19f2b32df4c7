"""The incremental mapper for unordered images: start, next best image, triangulate, adjust.

The steps are those of `mapper`; what differs is the order, which is chosen, and the adjustment: images are far apart
here, so that all of them are adjusted together, on their best tracks, whenever the map has grown.
"""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.images import ImageTracks, MappedImage, gather, renormalize, state_of
from factorsfm.initialization import NoStart, Start, start_essential, start_pair
from factorsfm.options import Options
from factorsfm.point_map import PointMap
from factorsfm.reconstruction import FrameStatus
from factorsfm.refinement import BundleAdjustment
from factorsfm.registration import register_image
from factorsfm.triangulation import triangulate

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_SMALLEST_PART = 3  # images, besides those of the first part
_MOST_COMMON_PAIRS = 300  # whose parallax is measured
_STARTS_TRIED = 4
_WIDE_ENOUGH_DEG = 8.0  # median angle of the rays beyond which a pair is no better for a start
_GEOMETRIC_DEG = 2.0  # median angle below which a start from depth is preferred
_LEAST_ANGLE_DEG = 1.5  # between the rays of a new point; less where those of the whole map are small
_LEAST_ANGLE_SHARE = 0.3  # of the median angle of the map
_WORKING_TRACKS = (150, 1000, 60_000)  # per image while the map grows: at least, at most, and in the whole set
_LEAST_FITTING, _MOST_CONTRADICTED = 0.5, 0.25  # shares of an image's observations, and of the images
_GROWTH = 0.1  # of the number of images after which the map is adjusted
_PYRAMID = (2, 4, 8, 16, 32)  # cells across, of the score by which the next image is chosen
_SIGMA_PX = 0.5  # of keypoints, until it is measured
_GOOD_PX = 4.0  # reprojection error of a good observation
_FOCAL_IMAGES, _FOCAL_ANGLE_DEG = 4, 3.0  # from which a guessed focal length is refined with the map


def map_parts(tracks: list[ImageTracks], focal: float, options: Options) -> list[SetMapper]:
    """A map of the images that belong together, and others among those that are left over.

    What cannot be joined to a map, for want of common tracks or because no pose agrees with it, gets a map of its own
    where at least three images make one.

    Returns:
        The maps by number of images, largest first. An image is registered in one of them at most; where it is not,
        its message says why it is not in the first map that was made. That one is there even without images.
    """
    parts: list[SetMapper] = []
    nothing = np.zeros(0, np.int64), np.zeros((0, 2))
    while True:
        mapper = SetMapper(tracks, focal, options)
        mapper.run()
        tried = [image for image in mapper.images if image.status is not FrameStatus.TOO_FEW_TRACKS]
        found = [image for image in mapper.images if image.registered]
        if not parts or len(found) >= _SMALLEST_PART:
            parts.append(mapper)
        done = {image.tracks.position for image in (found if len(found) >= _SMALLEST_PART else tried)}
        if not done:
            break
        tracks = [ImageTracks(t.position, *nothing) if t.position in done else t for t in tracks]
    for part in parts[1:]:  # there, images were missing
        for image, first in zip(part.images, parts[0].images, strict=True):
            if not image.registered:
                image.status, image.message = first.status, first.message
    return sorted(parts, key=lambda part: -part.registered)


class SetMapper:
    """Depth-guided incremental structure from motion over the tracks of an unordered set.

    Args:
        tracks: of all images, with the depth prior where there is one.
        focal: pixels; a guess that is refined with the map where the options say so.
        options: steps, thresholds and weights.

    Attributes:
        images: what became of each image; points: the map.
        focal: as the tracks of `images` are normalised with it.
    """

    def __init__(self, tracks: list[ImageTracks], focal: float, options: Options) -> None:
        self.focal = focal
        self.options = options.mapper
        self._refine_focal = options.refine_focal_length
        self._guess = focal
        self._adjustment = replace(options.polish, iterations=10, tolerance=1e-3)
        self.images = [MappedImage(t, FrameStatus.WAITING, "waiting for the start of the map") for t in tracks]
        self.points = PointMap()
        self._common = _common_tracks(tracks)
        self._order: list[MappedImage] = []  # of registration; the first one is the world
        self._adjusted = 0
        self._tried: dict[int, int] = {}  # by position: mapped tracks with which an image was tried last
        self._released: set[int] = set()  # positions of images that were taken out of the map again, once each
        self._held: set[int] = set()  # positions of the images whose poses are given
        self._angle = 0.0  # median angle between the rays of the latest points, degrees

    @property
    def registered(self) -> int:
        """Number of images with a pose."""
        return sum(image.registered for image in self.images)

    @property
    def parallax(self) -> float:
        """Largest distance of a camera from the first one, over the median distance of the points from that."""
        centers = np.array([-rotation.T @ translation for rotation, translation in (i.pose for i in self._order)])
        distance = float(np.median(np.linalg.norm(self.points.all()[1] - centers[0], axis=1)))
        return float(np.linalg.norm(centers - centers[0], axis=1).max()) / distance

    # --- the algorithm ------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Register all images that can be."""
        usable = self._usable()
        best: list[MappedImage] = []
        best_points = self.points
        for start in self._starts(usable):
            self._begin(start)
            self._grow(_longest_tracks([i.tracks for i in self.images]))
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

    def extend(self, known: dict[int, tuple[Array, Array]]) -> None:
        """Register all images that can be on those whose poses are known, which stay as they are.

        Args:
            known: `cam_from_world` rotation and translation by position, the first one near the origin of a world with
                a median distance of about 1.
        """
        for position, pose in known.items():
            self._accept(self.images[position], *pose, 0)
        self._held = set(known)
        self._grow(None)
        for image in self.images:
            if image.status is FrameStatus.WAITING:
                mapped = int(self.points.contains(image.tracks.ids).sum())
                image.status = FrameStatus.LOST
                image.message = f"{mapped} of {self.options.min_inliers} needed tracks have a point in the map"

    def _usable(self) -> list[int]:
        """The images of the largest component; the others learn why they are left out."""
        o = self.options
        component = _components(self._common >= o.min_inliers)
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
                    if len(self._order) >= self._adjusted * (1.0 + _GROWTH):
                        self._adjust()
                        self._extend(working)
            if len(self._order) == self._adjusted:
                return
            self._adjust()  # images that it releases come next
            self._extend(working)

    # --- start --------------------------------------------------------------------------------------------------

    def _starts(self, usable: list[int]) -> list[Start]:
        """Possible starts, the best one first: two-view geometry where parallax supports it, else the prior.

        With the start "pair" of the options, the paper's, the prior always comes first.
        """
        o = self.options
        tracks = [i.tracks for i in self.images]
        found: list[tuple[float, Start]] = []
        reason = f"{len(usable)} of 2 needed images have tracks in common"
        for a, b in self._pairs_with_parallax(usable):
            start = start_essential(
                tracks[a], tracks[b], o.min_tracks, focal=self.focal, sigma=_SIGMA_PX, angle_deg=0.0
            )
            if isinstance(start, NoStart):
                reason = start.reason
                continue
            angle = _median_angle(start)
            logger.debug("start from images %d and %d: %d points at %.1f degrees", a, b, len(start.ids), angle)
            found.append((len(start.ids) * min(angle, _WIDE_ENOUGH_DEG), start))
        starts = [start for _, start in sorted(found, key=lambda f: -f[0])]
        if o.initialization == "pair" or not starts or _median_angle(starts[0]) < _GEOMETRIC_DEG:
            lifted = self._start_from_depth(usable)
            if isinstance(lifted, Start):
                starts.insert(0, lifted)
        for k in usable:
            self.images[k].message = reason
        return starts

    def _pairs_with_parallax(self, usable: list[int]) -> list[tuple[int, int]]:
        """Pairs with many common tracks that move against each other beyond what a rotation explains."""
        a, b = np.triu_indices(len(usable), 1)
        a, b = np.array(usable, int)[a], np.array(usable, int)[b]
        most = np.argsort(-self._common[a, b], kind="stable")[:_MOST_COMMON_PAIRS]
        scores = []
        for i, j in zip(a[most].tolist(), b[most].tolist(), strict=True):
            if (n := int(self._common[i, j])) >= self.options.min_tracks:
                angle = _parallax_deg(self.images[i].tracks, self.images[j].tracks)
                scores.append((n * min(angle, _WIDE_ENOUGH_DEG), i, j))
        return [(i, j) for _, i, j in sorted(scores, reverse=True)[:_STARTS_TRIED]]

    def _start_from_depth(self, usable: list[int]) -> Start | NoStart:
        """The paper's: the pair with most matches."""
        o = self.options
        lifted = [k for k in usable if self.images[k].tracks.depth is not None]
        if o.initialization == "essential" or not lifted:
            return NoStart("no image has a usable depth map")
        common = self._common[np.ix_(lifted, usable)]
        a, b = np.unravel_index(int(np.argmax(common)), common.shape)
        pair = [self.images[lifted[a]].tracks, self.images[usable[b]].tracks]
        return start_pair(pair, o.min_tracks, focal=self.focal, sigma=_SIGMA_PX, inlier_px=o.inlier_px)

    def _begin(self, start: Start) -> None:
        for image in self._order:
            image.rotation = image.translation = None
        self.points, self._order, self._adjusted = PointMap(), [], 0
        self._released.clear()
        self._angle = _median_angle(start)
        self.points.set(start.ids, start.points)
        for position, rotation, translation in zip(start.images, start.rotation, start.translation, strict=True):
            self._accept(self.images[position], rotation, translation, len(start.ids))

    # --- registration -------------------------------------------------------------------------------------------

    def _next(self) -> MappedImage | None:
        """The image with most and best spread mapped tracks; one that failed waits until it sees more of the map."""
        best, best_score = None, 0
        for image in self.images:
            if image.registered or image.status is FrameStatus.TOO_FEW_TRACKS:
                continue
            mapped = self.points.contains(image.tracks.ids)
            n = int(mapped.sum())
            if n < self.options.min_inliers or n < 1.2 * self._tried.get(image.tracks.position, 0):
                continue
            score = _pyramid_score(image.tracks.xy, mapped)
            if score > best_score:
                best, best_score = image, score
        if best is not None:
            self._tried[best.tracks.position] = int(self.points.contains(best.tracks.ids).sum())
        return best

    def _register(self, image: MappedImage) -> bool:
        o, tracks = self.options, image.tracks
        mapped = self.points.contains(tracks.ids)
        near = max(self._order, key=lambda i: int(self._common[i.tracks.position, tracks.position]))
        result = register_image(
            self.points.at(tracks.ids[mapped]),
            tracks.xy[mapped],
            *near.pose,
            focal=self.focal,
            sigma=_SIGMA_PX,
            inlier_px=o.inlier_px,
        )
        found = int(result.inliers.sum())
        logger.debug("image %d: %d of %d inliers, %.2f px", tracks.position, found, mapped.sum(), result.error)
        if found < o.min_inliers:
            image.status = FrameStatus.TOO_FEW_INLIERS
            image.message = f"{found} of {o.min_inliers} needed inliers among {mapped.sum()} mapped tracks"
            return False
        self._accept(image, result.rotation, result.translation, found)
        return True

    def _accept(self, image: MappedImage, rotation: Array, translation: Array, inliers: int) -> None:
        image.rotation, image.translation, image.inliers = rotation, translation, inliers
        image.status, image.message, image.keyframe = FrameStatus.REGISTERED, f"{inliers} inliers", True
        self._order.append(image)

    # --- points -------------------------------------------------------------------------------------------------

    def _extend(self, working: Index | None, image: MappedImage | None = None) -> None:
        """Triangulate what has no point yet: of the working tracks, of one image or of all."""
        ids, count = np.unique(np.concatenate([i.tracks.ids for i in self._order]), return_counts=True)
        ids = ids[count >= 2]
        for some in (working, image.tracks.ids if image is not None else None):
            if some is not None:
                ids = ids[np.isin(ids, some, assume_unique=True)]
        ids = ids[~self.points.contains(ids)]
        if not len(ids):
            return
        result = triangulate(
            np.array([i.rotation for i in self._order]),
            np.array([i.translation for i in self._order]),
            gather(self._order, ids),
            focal=self.focal,
            inlier_px=_GOOD_PX,
            sigma=_SIGMA_PX,
            fallback=np.full(len(ids), 1e-3),
        )
        angle = np.degrees(result.angle)
        good = (result.inliers >= 2) & (result.inverse_distance > 1e-6)
        if good.any():
            self._angle = float(np.median(angle[good]))
        good &= angle > min(_LEAST_ANGLE_DEG, _LEAST_ANGLE_SHARE * self._angle)
        self.points.set(ids[good], result.bearing[good] / result.inverse_distance[good, None])

    def _adjust(self) -> None:
        """Bundle adjustment of all registered images; points without two good observations are forgotten."""
        ids, points = self.points.all()
        seen, count = np.unique(np.concatenate([i.tracks.ids for i in self._order]), return_counts=True)
        kept = np.isin(ids, seen[count >= 2], assume_unique=True)
        ids, points = ids[kept], points[kept]
        observations = gather(self._order, ids)
        state = state_of(self._order, points, self.focal)
        errors = BundleAdjustment(state, observations, self._adjustment, sigma=1.0).reprojection_errors()
        sigma = max(float(np.median(errors)), _SIGMA_PX)
        free_focal = self._refine_focal and len(self._order) >= _FOCAL_IMAGES and self._angle > _FOCAL_ANGLE_DEG
        held = np.array([image.tracks.position in self._held for image in self._order]) if self._held else None
        adjustment = BundleAdjustment(
            state, observations, self._adjustment, sigma=sigma, free_focal=free_focal, fixed=held
        )
        state = adjustment.solve()
        focal = float(np.exp(state.log_focal[0]))
        if free_focal and 0.3 < focal / self._guess < 3.0:
            self._set_focal(focal)
        errors = adjustment.reprojection_errors()
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

    def _set_focal(self, focal: float) -> None:
        renormalize(self.images, self.focal / focal)
        self.focal = focal


def _common_tracks(tracks: list[ImageTracks]) -> NDArray[np.int64]:
    """(n, n) number of tracks that two images have in common, 0 on the diagonal."""
    n = len(tracks)
    ids = np.concatenate([t.ids for t in tracks])
    image = np.repeat(np.arange(n), [len(t.ids) for t in tracks])
    order = np.argsort(ids, kind="stable")
    ids, image = ids[order], image[order]
    common = np.zeros((n, n), np.int64)
    for step in range(1, n):
        same = ids[step:] == ids[:-step]
        if not same.any():
            break
        np.add.at(common, (image[:-step][same], image[step:][same]), 1)
    return common + common.T


def _components(joined: NDArray[np.bool_]) -> Index:
    """(n,) label of the connected component of each node of an undirected graph."""
    label = np.arange(len(joined))
    while True:
        lowest = np.where(joined, label[None], len(joined)).min(axis=1, initial=len(joined))
        lower = np.minimum(label, lowest)
        if np.array_equal(lower, label):
            return label
        label = lower


def _longest_tracks(tracks: list[ImageTracks]) -> Index:
    """Ids of the tracks on which the map grows: the longest ones of each image."""
    least, most, total = _WORKING_TRACKS
    count = int(np.clip(total // len(tracks), least, most))
    length = np.bincount(np.concatenate([t.ids for t in tracks]))
    chosen = [t.ids[np.argsort(-length[t.ids], kind="stable")[:count]] for t in tracks]
    return np.unique(np.concatenate(chosen))


def _median_angle(start: Start) -> float:
    """Median angle between the rays of the points (degrees)."""
    a, b = (start.points + r.T @ t for r, t in list(zip(start.rotation, start.translation, strict=True))[:2])
    cosine = np.einsum("ni,ni->n", a, b) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _parallax_deg(a: ImageTracks, b: ImageTracks) -> float:
    """Median angle between the rays of common tracks after the rotation that fits them best."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    rays = [np.concatenate([t.xy[rows], np.ones((len(rows), 1))], 1) for t, rows in ((a, in_a), (b, in_b))]
    first, second = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays)
    weight = np.ones(len(first))
    angle = weight
    for _ in range(3):  # robust: matches may be wrong
        u, _, vt = np.linalg.svd((first * weight[:, None]).T @ second)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        angle = np.linalg.norm(first @ turn - second, axis=1)
        weight = 1.0 / (1.0 + (angle / max(float(np.median(angle)), 1e-9)) ** 2)
    return float(np.degrees(np.median(angle)))


def _pyramid_score(xy: Array, mapped: NDArray[np.bool_]) -> int:
    """Number of mapped keypoints and their spread: occupied cells at several resolutions, fine ones counting more."""
    low, extent = xy.min(0), np.maximum(np.ptp(xy, axis=0), 1e-9)
    place = np.clip((xy[mapped] - low) / extent, 0.0, 1.0 - 1e-9)
    score = 0
    for cells in _PYRAMID:
        cell = (place * cells).astype(np.int64)
        score += cells * len(np.unique(cell[:, 0] * cells + cell[:, 1]))
    return score
