"""From the start of an object to all frames that see it: registered on its points, which are triangulated further."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.noise import FIRST_SIGMA_PX
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.registration import register_image
from factorsfm.mapping.triangulation import triangulate
from factorsfm.objects.start import LEAST_TRACKS, ObjectStart
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks, seen_by

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Poses = dict[int, tuple[Array, Array]]

logger = logging.getLogger(__name__)

_KNOWN = 0.5  # share of a frame's tracks that have a point: with less, the points grow before it is registered
_VIEWS = 3  # of a track whose point is triangulated
_CAMERAS = 40  # that are solved together as the object grows
_ITERATIONS = 6


def grown(
    start: ObjectStart, images: Sequence[ImageTracks], options: Options
) -> tuple[list[MappedImage], Index, Array]:
    """All frames that can be registered on an object.

    Args:
        images: that see the object, by time.

    Returns:
        An image for each, the ids (n,) of the points, and the points (n, 3), in the world of the start.
    """
    row_of = {image.position: row for row, image in enumerate(images)}
    poses: Poses = {
        row_of[image.position]: (start.state.rotation[k], start.state.translation[k])
        for k, image in enumerate(start.images)
    }
    ids, points = start.ids, start.state.points
    while True:
        new = _registered(images, poses, ids, points, options)
        poses |= new
        ids, points = _with_new_points(images, poses, options)
        if not new:
            break
    mapped = [_mapped(image, poses.get(row)) for row, image in enumerate(images)]
    logger.info("object: %d of %d frames, %d points", len(poses), len(images), len(ids))
    return mapped, ids, points


def _registered(images: Sequence[ImageTracks], poses: Poses, ids: Index, points: Array, options: Options) -> Poses:
    """Further frames, each from the pose of the nearest in time: those that know most of their tracks, or else any."""
    o = options.mapper
    waiting = [row for row in range(len(images)) if row not in poses]
    known = {row: np.isin(images[row].ids, ids) for row in waiting}
    enough = [row for row in waiting if known[row].sum() >= LEAST_TRACKS]
    sure = [row for row in enough if known[row].mean() >= _KNOWN]
    found: Poses = {}
    for row in sure or enough:
        nearest = min((*poses, *found), key=lambda other: abs(other - row))
        image = images[row].of(known[row])
        at = np.searchsorted(ids, image.ids)
        pose = register_image(
            points[at], image.xy, *(found.get(nearest) or poses[nearest]),
            focal=image.camera.mean_focal_length(), sigma=o.pixel_sigma, inlier_px=o.inlier_px,
        )  # fmt: skip
        if pose.inliers.sum() >= o.min_inliers:
            found[row] = pose.rotation, pose.translation
    return found


def _with_new_points(images: Sequence[ImageTracks], poses: Poses, options: Options) -> tuple[Index, Array]:
    """All tracks triangulated from the frames that are registered, and both adjusted; the poses change in place."""
    rows = sorted(poses)
    few = [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _CAMERAS)).astype(int))]
    seen = [images[row] for row in few]
    ids = seen_by(seen, min(_VIEWS, len(few)))
    focal = np.array([image.camera.mean_focal_length() for image in seen])
    observations = gather(seen, ids, focal)
    cameras = State(
        np.array([poses[row][0] for row in few]), np.array([poses[row][1] for row in few]),
        np.zeros((len(ids), 3)), np.ones(len(ids)), np.log(focal), group=np.arange(len(few)),
    )  # fmt: skip
    found = triangulate(
        cameras, observations, inlier_px=options.mapper.inlier_px, sigma=FIRST_SIGMA_PX, fallback=np.ones(len(ids))
    )
    typical = float(np.median(found.inverse_distance))
    inverse = np.clip(found.inverse_distance, 0.5 * typical, 2.0 * typical)  # nothing of the thing is nearer or farther
    state = replace(cameras, bearing=found.bearing, inverse_distance=inverse)
    polish = replace(options.polish, iterations=_ITERATIONS)
    state = BundleAdjustment(state, observations, polish, ErrorModel(FIRST_SIGMA_PX)).solve()
    poses.update({row: (state.rotation[k], state.translation[k]) for k, row in enumerate(few)})
    return ids, state.points


def _mapped(image: ImageTracks, pose: tuple[Array, Array] | None) -> MappedImage:
    if pose is None:
        return MappedImage(image, FrameStatus.TOO_FEW_INLIERS, "too few points of the object are seen")
    return MappedImage(image, FrameStatus.REGISTERED, "", *pose)
