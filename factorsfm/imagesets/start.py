"""Where the map of an unordered set starts: which pair of images, by two-view geometry or lifted by the prior."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.starts import NoStart, Start, start_essential, start_pair
from factorsfm.support.options import MapperOptions
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_MOST_COMMON_PAIRS = 300  # whose parallax is measured
_STARTS_TRIED = 4
_WIDE_ENOUGH_DEG = 8.0  # median angle of the rays beyond which a pair is no better for a start
_GEOMETRIC_DEG = 2.0  # median angle below which a start from depth is preferred


def possible_starts(
    tracks: Sequence[ImageTracks], common: Index, options: MapperOptions, focal: float
) -> list[Start] | NoStart:
    """Starts, the best one first: two-view geometry where parallax supports it, else the prior.

    With the start "pair" of the options, the paper's, the prior always comes first.

    Args:
        tracks: of the images that can be used; common: how many of them each two have in common.
        focal: pixels.
    """
    found: list[tuple[float, Start]] = []
    reason = f"{len(tracks)} of 2 needed images have tracks in common"
    for a, b in _pairs_with_parallax(tracks, common, options.min_tracks):
        start = start_essential(
            tracks[a], tracks[b], options.min_tracks, focal=focal, sigma=options.pixel_sigma, angle_deg=0.0
        )
        if isinstance(start, NoStart):
            reason = start.reason
            continue
        angle = median_angle(start)
        logger.debug("start from images %s: %d points at %.1f degrees", start.images, len(start.ids), angle)
        found.append((len(start.ids) * min(angle, _WIDE_ENOUGH_DEG), start))
    starts = [start for _, start in sorted(found, key=lambda f: -f[0])]
    if options.initialization == "pair" or not starts or median_angle(starts[0]) < _GEOMETRIC_DEG:
        lifted = _start_from_depth(tracks, common, options, focal)
        if isinstance(lifted, Start):
            starts.insert(0, lifted)
    return starts or NoStart(reason)


def median_angle(start: Start) -> float:
    """Median angle between the rays of the points to the first two images (degrees)."""
    a, b = (start.points + r.T @ t for r, t in list(zip(start.rotation, start.translation, strict=True))[:2])
    cosine = np.einsum("ni,ni->n", a, b) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _pairs_with_parallax(tracks: Sequence[ImageTracks], common: Index, min_tracks: int) -> list[tuple[int, int]]:
    """Pairs with many common tracks that move against each other beyond what a rotation explains."""
    a, b = np.triu_indices(len(tracks), 1)
    most = np.argsort(-common[a, b], kind="stable")[:_MOST_COMMON_PAIRS]
    scores = []
    for i, j in zip(a[most].tolist(), b[most].tolist(), strict=True):
        if (n := int(common[i, j])) >= min_tracks:
            scores.append((n * min(_parallax_deg(tracks[i], tracks[j]), _WIDE_ENOUGH_DEG), i, j))
    return [(i, j) for _, i, j in sorted(scores, reverse=True)[:_STARTS_TRIED]]


def _start_from_depth(
    tracks: Sequence[ImageTracks], common: Index, options: MapperOptions, focal: float
) -> Start | NoStart:
    """The paper's: the pair with most matches."""
    lifted = [k for k, t in enumerate(tracks) if t.depth is not None]
    if options.initialization == "essential" or not lifted:
        return NoStart("no image has a usable depth map")
    a, b = np.unravel_index(int(np.argmax(common[lifted])), (len(lifted), len(tracks)))
    pair = [tracks[lifted[a]], tracks[int(b)]]
    return start_pair(pair, options.min_tracks, focal=focal, sigma=options.pixel_sigma, inlier_px=options.inlier_px)


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
