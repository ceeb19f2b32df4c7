"""An image on the map: its pose from the points that its tracks or its corners show, and which points it shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.residuals import camera_points
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.registration import Registration, inlier_threshold, register_image, residuals
from factorsfm.support.options import MapperOptions
from factorsfm.support.status import FrameStatus

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CONSENSUS = 0.8  # share of the inliers of the image before that is enough, however roughly they agree
_LEAST_RELOCALIZED = 0.7  # of the similar corners must agree with the pose; in a whole view nine tenths do


@dataclass(frozen=True, slots=True)
class NotOnMap:
    """Why an image has no pose: `message` says the same as `status`, with numbers."""

    status: FrameStatus
    message: str


def register_on_map(
    image: MappedImage,
    points: PointMap,
    near: MappedImage,
    focal: float,
    options: MapperOptions,
    *,
    in_order: bool,
) -> Registration | NotOnMap:
    """PnP on the mapped tracks, then refinement with the depth prior where the options say so.

    Args:
        near: the registered image whose pose is the first guess.
        focal: pixels.
        in_order: whether `near` is its neighbour in time: then most of the inliers of `near` are expected here, too,
            the more, the wider the threshold is.

    Returns:
        A registration whose inliers are marked among all tracks of the image, (n,).
    """
    o, tracks = options, image.tracks
    mapped = points.contains(tracks.ids)
    if mapped.sum() < o.min_inliers:
        message = f"{mapped.sum()} of {o.min_inliers} needed tracks have a point in the map"
        return NotOnMap(FrameStatus.LOST, message)
    depth = None
    if o.registration_depth != "none" and tracks.depth is not None:
        depth = tracks.depth.of(mapped)
    result = register_image(
        points.at(tracks.ids[mapped]),
        tracks.xy[mapped],
        *near.pose,
        focal=focal,
        sigma=o.pixel_sigma,
        inlier_px=o.inlier_px,
        depth=depth,
        domain="depth" if o.registration_depth == "paper" else "inverse",
        depth_weight=o.depth_weight,
    )
    found = int(result.inliers.sum())
    needed = _needed_inliers(near, result.threshold, o.min_inliers) if in_order else o.min_inliers
    if found < needed:
        within = f"within {result.threshold:.1f} pixels among {mapped.sum()} mapped tracks"
        return NotOnMap(FrameStatus.TOO_FEW_INLIERS, f"{found} of {needed} needed inliers {within}")
    inliers = np.zeros(len(tracks.ids), bool)
    inliers[np.nonzero(mapped)[0][result.inliers]] = True
    return replace(result, inliers=inliers)


def _needed_inliers(near: MappedImage, threshold: float, least: int) -> int:
    """How many inliers an image needs beside its neighbour in time.

    More tracks agree by chance within a threshold that is suddenly wider, and the image may show something else: the
    more of the threshold's area is new, the more of the inliers before must still be there. A young map is always
    rough.
    """
    new_area = max(0.0, 1.0 - (near.threshold / threshold) ** 2)
    most = max(least, _CONSENSUS * near.inliers)
    return math.ceil(least + new_area**2 * (most - least))


def fits_pose(
    image: MappedImage, ids: Index, points: PointMap, focal: float, options: MapperOptions
) -> NDArray[np.bool_]:
    """(n,) which mapped tracks (ascending) do not contradict the pose of an image: inliers, and what it does not see.

    Where hardly any is an inlier, the pose is wrong, and nothing contradicts it.

    Args:
        image: sees some of them; focal: pixels.
    """
    seen, tracks = np.isin(ids, image.tracks.ids), image.tracks
    error = residuals(points.at(ids[seen]), tracks.xy[np.isin(tracks.ids, ids)], *image.pose, focal)
    inliers = error < inlier_threshold(error, options.inlier_px)
    fits = np.ones(len(ids), bool)
    fits[seen] = inliers | (inliers.sum() < options.min_inliers)
    return fits


def register_by_corners(
    ids: Index, xy: Array, points: PointMap, near: MappedImage, focal: float, options: MapperOptions
) -> tuple[Registration | None, str]:
    """The pose of an image by what its descriptors say that it shows, None where they do not agree; and how many do.

    Args:
        ids: (n,) tracks that look like corners of the image; xy: (n, 2) these corners, normalised.
        near, focal: as in `register_on_map`.
    """
    o = options
    known = points.contains(ids)
    if known.sum() < o.min_inliers:
        return None, ""
    result = register_image(
        points.at(ids[known]), xy[known], *near.pose, focal=focal, sigma=o.pixel_sigma, inlier_px=o.inlier_px
    )
    found = int(result.inliers.sum())
    agree = f"{found} of {known.sum()} similar corners agree"
    return (result if found >= max(o.min_inliers, _LEAST_RELOCALIZED * known.sum()) else None), agree


def visible(image: MappedImage, points: PointMap, ids: Index) -> tuple[Index, Array]:
    """Tracks with a point in front of a registered image, and where it is seen (normalised)."""
    ids = ids[points.contains(ids)]
    rotation, translation = image.pose
    q = camera_points(rotation, translation, points.at(ids), np.ones(len(ids)))
    front = q[:, 2] > 1e-6
    return ids[front], q[front, :2] / q[front, 2:]
