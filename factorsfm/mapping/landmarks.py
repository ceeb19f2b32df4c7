"""Landmarks of the map: which tracks become one, and the points that the graph leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.mapping.depth_guidance import DepthGuidance
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.mapped_images import MappedImage, state_of
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.triangulation import Triangulation, triangulate
from factorsfm.motion.suspects import agreeing
from factorsfm.support.options import MapperOptions, PolishOptions
from factorsfm.tracks.image_tracks import seen_by

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_GROSS = 4.0  # times the threshold of an inlier: a young map is wrong, too, and long tracks are precious
_REACH = 60  # images to both sides of a lost one from which its tracks are triangulated: more tell hardly more
_FARTHEST = 1e-6  # smallest inverse distance of a point
_ALONE_ITERATIONS = 4
_JUDGED_VIEWS = 3  # keyframes that must see a suspect: two leave its depth a free choice
_SOLVER = replace(PolishOptions(), tolerance=1e-3)


def mapped_landmarks(window: Sequence[MappedImage], points: PointMap) -> Index:
    """Mapped tracks that two keyframes of the window see."""
    ids = seen_by([image.tracks for image in window], 2)
    return ids[points.contains(ids)]


def add_landmarks(copy: MapCopy, window: list[MappedImage], guidance: DepthGuidance) -> None:
    """Tracks of the new keyframe that become landmarks: well spread, triangulated from the keyframes that see them."""
    o, newest = copy.options, window[-1]
    known = copy.points.contains(newest.tracks.ids)
    seen = np.concatenate([image.tracks.ids for image in window[:-1]])
    candidates = ~known & np.isin(newest.tracks.ids, seen)
    room = o.landmarks - int(known.sum())
    if room < o.landmarks // 10 or not candidates.any():
        return
    chosen = _spread(newest.tracks.xy, known, np.nonzero(candidates)[0], room)
    _add_points(copy.points, window, newest, np.sort(newest.tracks.ids[chosen]), guidance, copy.focal)


def add_tracks(
    points: PointMap, images: Sequence[MappedImage], near: MappedImage, ids: Index, options: MapperOptions, focal: float
) -> int:
    """Points for tracks that registered images see, keyframes or not, until the graph knows better; their number.

    Args:
        points: the map to which they are added.
        images: registered; near: one of them; ids: those of its tracks that are wanted.
        focal: pixels.
    """
    ids = np.intersect1d(ids, seen_by([image.tracks for image in images], 2))
    ids = ids[~points.contains(ids)]
    return _add_points(points, images, near, ids, DepthGuidance(options, points), focal) if len(ids) else 0


def map_tracks(
    image: MappedImage, images: Sequence[MappedImage], points: PointMap, options: MapperOptions, focal: float
) -> bool:
    """Points for the tracks that an image without a pose shares with registered ones; whether there are any.

    Args:
        images: of the shot, in order of time.
    """
    position = image.tracks.position
    around = images[max(0, position - _REACH) : position + _REACH + 1]
    registered = [other for other in around if other.registered]
    if not registered:
        return False
    near = min(registered, key=lambda other: abs(other.tracks.position - position))
    shared = np.intersect1d(near.tracks.ids, image.tracks.ids, assume_unique=True)
    return add_tracks(points, registered, near, shared, options, focal) > 0


def agreeing_tracks(
    images: Sequence[MappedImage], points: PointMap, suspects: Index, focal: float, options: MapperOptions
) -> tuple[Index, NDArray[np.bool_]]:
    """Which suspected tracks agree with the map, under the poses of some registered images.

    Args:
        suspects: (n,) ids, ascending; focal: pixels.

    Returns:
        The ids (m,) of those of them that enough of the images see, and whether they agree.
    """
    judged, observations, errors, suspected = errors_on_map(images, points, suspects, focal, options)
    if not suspected.any() or suspected.all():
        return judged, np.zeros(len(judged), bool)
    return judged, agreeing(observations, errors, suspected)[suspected]


def errors_on_map(
    images: Sequence[MappedImage], points: PointMap, suspects: Index, focal: float, options: MapperOptions
) -> tuple[Index, Observations, Array, NDArray[np.bool_]]:
    """Errors of the mapped tracks and of suspected ones, which get points under the poses of some registered images.

    Args:
        suspects: (n,) ids, ascending; focal: pixels.

    Returns:
        The ids (k,) of those suspects that enough of the images see, the observations (m,) of them and of the map,
        their reprojection errors in pixels, and which of the points are suspects; without errors where either is none.
    """
    seen = [image.tracks for image in images]
    judged = np.intersect1d(seen_by(seen, _JUDGED_VIEWS), suspects)
    scene = np.setdiff1d(seen_by(seen, 2), suspects)
    scene = scene[points.contains(scene)]
    ids = np.union1d(scene, judged)
    suspected = np.isin(ids, judged)
    observations = gather(seen, ids, focal)
    if not len(judged) or not len(scene):
        return judged, observations, np.zeros(0), suspected
    cameras = state_of(images, points.at(scene), focal)
    bearing, inverse = np.empty((len(ids), 3)), np.empty(len(ids))
    bearing[~suspected], inverse[~suspected] = cameras.bearing, cameras.inverse_distance
    found = triangulate(
        cameras, observations.of(np.flatnonzero(suspected)), inlier_px=options.inlier_px, sigma=options.pixel_sigma,
        fallback=np.full(len(judged), float(np.median(cameras.inverse_distance))),
    )  # fmt: skip
    bearing[suspected], inverse[suspected] = found.bearing, found.inverse_distance
    state = replace(cameras, bearing=bearing, inverse_distance=inverse)
    errors = BundleAdjustment(state, observations, _SOLVER, ErrorModel(options.pixel_sigma)).reprojection_errors()
    return judged, observations, errors, suspected


def triangulate_tracks(
    images: Sequence[MappedImage],
    ids: Index,
    guidance: DepthGuidance,
    *,
    focal: float,
    inlier_px: float,
    fallback: Array,
) -> Triangulation:
    """Points of some tracks (ascending ids) from the images that see them, with the depth prior of the options.

    Args:
        images: registered; focal, inlier_px: pixels.
        fallback: (n,) inverse distance along the first ray where the views leave it open.
    """
    affine, prior = guidance.at_observations(images, ids)
    return triangulate(
        state_of(images, np.zeros((0, 3)), focal),
        gather([image.tracks for image in images], ids, focal),
        inlier_px=inlier_px,
        sigma=guidance.options.pixel_sigma,
        fallback=fallback,
        affine=affine,
        prior=prior,
        in_graph=guidance.options.triangulation_depth == "paper",
    )


def solve_alone(
    copy: MapCopy,
    images: list[MappedImage],
    update: MapUpdate,
    ids: Index,
    guidance: DepthGuidance,
    contradicting: Index,
) -> MapUpdate:
    """The update with further points, each solved alone with the poses of the update.

    Args:
        ids: tracks (ascending); contradicting: those that did not fit before, and must now fit as inliers do.
    """
    moved = [replace(image) for image in images]
    for image in moved:
        position = image.tracks.position
        image.rotation, image.translation = update.poses.get(position, image.pose)
        image.affine = update.affines.get(position, image.affine)
    affine, prior = guidance.at_observations(moved, ids)
    state = state_of(moved, copy.points.at(ids), update.focal or copy.focal)
    if affine is not None:
        state = replace(state, scale=affine[:, 0], shift=affine[:, 1], field=np.zeros(1))
    alone = BundleAdjustment(
        state, gather([image.tracks for image in moved], ids, copy.focal), _SOLVER,
        ErrorModel(copy.options.pixel_sigma), prior=prior, free=Free(cameras=False),
    )  # fmt: skip
    state = alone.solve(_ALONE_ITERATIONS)
    errors = np.sqrt(alone.observations.mean_by_point(alone.reprojection_errors() ** 2))
    limit = np.where(np.isin(ids, contradicting), 1.0, _GROSS) * copy.options.inlier_px
    good = (state.inverse_distance > _FARTHEST) & (errors < limit)
    every, points = np.concatenate([update.ids, ids[good]]), np.concatenate([update.points, state.points[good]])
    order = np.argsort(every)
    return replace(update, ids=every[order], points=points[order], removed=np.union1d(update.removed, ids[~good]))


def _add_points(
    points: PointMap,
    images: Sequence[MappedImage],
    near: MappedImage,
    ids: Index,
    guidance: DepthGuidance,
    focal: float,
) -> int:
    """Triangulate tracks of `near` (ascending) from all images, and add what they agree on to the map."""
    found = triangulate_tracks(
        images, ids, guidance,
        focal=focal, inlier_px=guidance.options.inlier_px, fallback=guidance.fallback(near, ids),
    )  # fmt: skip
    good = (found.inliers >= 2) & (found.inverse_distance > _FARTHEST)
    points.set(ids[good], found.points(good))
    return int(good.sum())


def _spread(xy: Array, taken: NDArray[np.bool_], candidates: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """`count` of the candidates, taken in turn from the emptiest cells of a grid; older tracks come first."""
    cell = np.floor((xy - xy.min(0)) / np.maximum(np.ptp(xy, axis=0), 1e-9) * [15.99, 8.99]).astype(int)
    key = cell[:, 0] * 9 + cell[:, 1]
    load = np.bincount(key[taken], minlength=144)
    order = candidates[np.argsort(key[candidates], kind="stable")]
    first = np.searchsorted(key[order], np.arange(144))
    rank = np.arange(len(order)) - first[key[order]] + load[key[order]]
    return np.asarray(order[np.argsort(rank, kind="stable")[:count]])
