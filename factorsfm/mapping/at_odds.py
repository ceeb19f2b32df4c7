"""How much of the view is at odds with the map: what moves by itself, or the scene while the map is of what moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.landmarks import errors_on_map
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.motion.moving import log_errors
from factorsfm.motion.neighbours import share_of_image
from factorsfm.support.options import MapperOptions
from factorsfm.tracks.image_tracks import ImageTracks

Index = NDArray[np.int64]

EVERY = 4  # keyframes after which it is asked: it takes a fifth of the time of an update
_MUCH = 0.25  # of the image, from which the map itself is in doubt: one thing may well cover the rest
_KEYFRAMES = 8  # the newest, in which tracks are compared with the map
# Times the noise of a tracked point, and times the typical error of the map: clean shots have 0 to 1 % of the image
# beyond both, and actors in shots all of theirs.
_OFF, _OFF_MAP = 4.0, 2.0


def share_at_odds(images: Sequence[MappedImage], points: PointMap, focal: float, options: MapperOptions) -> float:
    """Share of the newest image whose tracks no point explains under the poses of the keyframes.

    Args:
        images: keyframes as the map has them, in order; focal: pixels.
    """
    images = images[-_KEYFRAMES:]
    newest = images[-1].tracks
    unmapped = np.sort(newest.ids[~points.contains(newest.ids)])
    judged, observations, errors, suspected = errors_on_map(images, points, unmapped, focal, options)
    if not suspected.any() or suspected.all():
        return 0.0
    typical = np.exp(log_errors(observations, errors))
    limit = max(_OFF * options.pixel_sigma, _OFF_MAP * float(np.median(typical[~suspected])))
    fits = judged[typical[suspected] <= limit]
    mapped = newest.ids[points.contains(newest.ids)]
    return share_left_out(newest, np.union1d(mapped, judged), np.union1d(mapped, fits))


def share_left_out(image: ImageTracks, known: Index, scene: Index) -> float:
    """Share of an image that belongs to those of the known tracks (ids) that are not among the scene's."""
    judged = np.isin(image.ids, known)
    size = image.camera.width, image.camera.height
    return share_of_image(image.pixels[judged], ~np.isin(image.ids[judged], scene), size)


def became_much(before: float, now: float) -> str:
    """One sentence where the share that is at odds has become so large that the map itself is in doubt; else empty."""
    if before >= _MUCH or now < _MUCH:
        return ""
    return (
        f"{now:.0%} of the image is at odds with the map: it moves by itself, or it is the scene and the map is "
        "that of what moves"
    )
