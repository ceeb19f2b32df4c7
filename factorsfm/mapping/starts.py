"""The start of a reconstruction: from one image lifted by its depth, from the paper's pair, or without depth."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.mapping.registration import register_image
from factorsfm.mapping.triangulation import triangulate
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.tracks.image_tracks import ImageTracks, median_flow, shared_tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A relative inverse depth of (almost) zero is a point at (almost) infinity; nothing is lifted farther than this.
_FARTHEST = 20.0
_FARTHEST_BASELINES = 1e5
_SAMPLE = 40  # images among which the one that shares most is sought
_PARTNERS = 5  # tried with it


@dataclass(frozen=True, slots=True)
class Start:
    """Initial map: images with their poses, and points by track.

    Attributes:
        images: positions of the registered images.
        rotation, translation: `cam_from_world` of each.
        ids: (n,) tracks with a point; points: (n, 3).
    """

    images: list[int]
    rotation: list[Array]
    translation: list[Array]
    ids: Index
    points: Array


@dataclass(frozen=True, slots=True)
class NoStart:
    """Why there is no start yet, with numbers."""

    reason: str


def lift(xy: Array, depth: ImageDepth) -> tuple[Array, NDArray[np.bool_]]:
    """``P = D[p] K^-1 h(p)`` in the camera frame, with depths in units of the image's median.

    Returns:
        Points (n, 3) and which are valid.
    """
    valid = depth.valid
    inverse = np.where(valid, np.maximum(depth.inverse_depth, 1.0 / _FARTHEST), 1.0)
    return np.concatenate([xy, np.ones((len(xy), 1))], 1) / inverse[:, None], valid


def start_lifted(image: ImageTracks, min_tracks: int) -> Start | NoStart:
    """One image is enough: its lifted points are the map on which the next images are registered."""
    if image.depth is None:
        return NoStart(f"frame {image.position} has no depth map to lift")
    points, valid = lift(image.xy, image.depth)
    if valid.sum() < min_tracks:
        return NoStart(f"{valid.sum()} of {min_tracks} needed tracks have a valid depth")
    return Start([image.position], [np.eye(3)], [np.zeros(3)], image.ids[valid], points[valid])


def start_pair(
    images: list[ImageTracks], min_tracks: int, *, focal: float, sigma: float, inlier_px: float
) -> Start | NoStart:
    """The paper's start: the pair with most matches of valid depth, lift the first image, PnP the second."""
    best, best_count = None, 0
    for i, a in enumerate(images):
        if a.depth is None:
            continue
        liftable = a.ids[a.depth.valid]
        for b in images[:i] + images[i + 1 :]:
            count = int(np.isin(b.ids, liftable, assume_unique=True).sum())
            if count > best_count:
                best, best_count = (a, b), count
    if best is None or best_count < min_tracks:
        return NoStart(f"the best pair has {best_count} of {min_tracks} needed matches with a valid depth")
    a, b = best
    assert a.depth is not None
    points, valid = lift(a.xy, a.depth)
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    use = valid[in_a]
    result = register_image(
        points[in_a[use]],
        b.xy[in_b[use]],
        np.eye(3),
        np.zeros(3),
        focal=focal,
        sigma=sigma,
        inlier_px=inlier_px,
    )
    if result.inliers.sum() < min_tracks // 2:
        return NoStart(f"PnP of the best pair has {result.inliers.sum()} of {min_tracks // 2} needed inliers")
    return Start(
        [a.position, b.position], [np.eye(3), result.rotation], [np.zeros(3), result.translation],
        a.ids[valid], points[valid],
    )  # fmt: skip


def start_essential(
    first: ImageTracks, second: ImageTracks, min_tracks: int, *, focal: float, sigma: float, angle_deg: float
) -> Start | NoStart:
    """The start without depth: essential matrix, then triangulation, accepted if its rays meet at an angle.

    The median depth of the points is the unit of the map.
    """
    ids, in_a, in_b = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    if len(ids) < min_tracks:
        return NoStart(f"{len(ids)} of {min_tracks} needed tracks join frames {first.position} and {second.position}")
    a, b = first.xy[in_a], second.xy[in_b]
    essential, mask = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=3.0 * sigma / focal
    )
    if essential is None or essential.shape != (3, 3):
        return NoStart(f"no essential matrix fits frames {first.position} and {second.position}")
    # The default drops points beyond 50 baselines, which in these shots are all of them.
    _, rotation, translation, *_ = cv2.recoverPose(
        essential, a, b, np.eye(3), distanceThresh=_FARTHEST_BASELINES, mask=mask.copy()
    )
    keep = mask.ravel() > 0
    n = int(keep.sum())
    observations = Observations(
        np.tile([0, 1], n), np.repeat(np.arange(n), 2), focal * np.stack([a[keep], b[keep]], 1).reshape(-1, 2)
    )
    cameras = State(
        np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation.ravel()]),
        np.zeros((0, 3)), np.zeros(0), np.log([focal]),
    )  # fmt: skip
    points = triangulate(cameras, observations, inlier_px=4.0 * sigma, sigma=sigma, fallback=np.full(n, 1e-6))
    good = (points.inliers == 2) & (points.inverse_distance > 1e-4)
    angle = float(np.degrees(np.median(points.angle[good]))) if good.any() else 0.0
    if good.sum() < min_tracks or angle < angle_deg:
        return NoStart(
            f"{good.sum()} of {min_tracks} needed points with a median triangulation angle of {angle:.2f} of "
            f"{angle_deg:.2f} degrees needed"
        )
    unit = float(np.median(points.inverse_distance[good]))
    return Start(
        [first.position, second.position], [np.eye(3), rotation], [np.zeros(3), translation.ravel() * unit],
        ids[keep][good], points.bearing[good] / points.inverse_distance[good, None] * unit,
    )  # fmt: skip


def start_essential_among(
    images: Sequence[ImageTracks], min_tracks: int, *, focal: float, sigma: float, angle_deg: float
) -> Start | NoStart:
    """`start_essential` of the last image and the first one that still shares its tracks, as not after a fade.

    With no angle asked for: of the one that shares tracks with most others, and the partner with most parallax.
    """
    if len(images) < 2:
        return NoStart(f"{len(images)} of 2 needed images")
    if angle_deg > 0.0:
        # The later an image, the more it shares with the last one.
        sharing = bisect_left(images[:-1], min_tracks, key=lambda t: shared_tracks(t, images[-1]))
        first = images[sharing if sharing <= len(images) // 2 else 0]  # not because of what came at last
        partners = list(images[-1:])
    else:
        sample = images[:: len(images) // _SAMPLE + 1]
        first = max(sample, key=lambda t: sum(shared_tracks(t, other) >= min_tracks for other in sample))
        partners = [t for t in images if t is not first and shared_tracks(first, t) >= min_tracks]
        partners = sorted(partners, key=lambda t: -median_flow(first, t))[:_PARTNERS]
    start: Start | NoStart = NoStart("no partner")
    for second in partners:
        start = start_essential(first, second, min_tracks, focal=focal, sigma=sigma, angle_deg=angle_deg)
        if isinstance(start, Start):
            break
    return start


def start_flat(images: Sequence[ImageTracks]) -> Start | NoStart:
    """All points at one depth: enough for the rotations of a shot that has no translation to offer."""
    if not images:
        return NoStart("no image with enough tracks")
    first = images[0]
    points = np.concatenate([first.xy, np.ones((len(first.xy), 1))], 1)
    return Start([first.position], [np.eye(3)], [np.zeros(3)], first.ids, points)
