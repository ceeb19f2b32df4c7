"""The maps of a set of images that do not all belong together."""

from __future__ import annotations

import numpy as np

from factorsfm.imagesets.mapper import SetMapper
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

_SMALLEST_PART = 3  # images, besides those of the first part


def map_parts(tracks: list[ImageTracks], focal: float, options: Options) -> list[SetMapper]:
    """A map of the images that belong together, and others among those that are left over.

    What cannot be joined to a map, for want of common tracks or because no pose agrees with it, gets a map of its own
    where at least three images make one.

    Returns:
        The maps by number of images, largest first. An image is registered in one of them at most; where it is not,
        its message says why it is not in the first map that was made. That one is there even without images.
    """
    parts: list[SetMapper] = []
    nothing = np.zeros(0, np.int64)
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
        tracks = [t.of(nothing) if t.position in done else t for t in tracks]
    for part in parts[1:]:  # there, images were missing
        for image, first in zip(part.images, parts[0].images, strict=True):
            if not image.registered:
                image.status, image.message = first.status, first.message
    return sorted(parts, key=lambda part: -part.registered)
