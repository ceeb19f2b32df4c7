"""Lost views found again, and tracks taken up again where their points are back in view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.projection import pixels_from_normalized
from factorsfm.mapping.map_registration import visible
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.streaming.relocalization import KeyframeView, Relocalizer
from factorsfm.support.pace import frames_in
from factorsfm.tracks.flow import FlowTracker

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_REVIVAL_SECONDS = 0.2  # between two looks for ended tracks that may be back in view


class ViewFinder:
    """Remembers the views of the keyframes, and knows which ended tracks an image should show.

    Args:
        tracker: of the stream.
        views, next_view: see `Relocalizer`.
    """

    def __init__(self, tracker: FlowTracker, views: Sequence[KeyframeView] = (), next_view: int = 0) -> None:
        self._tracker = tracker
        self.relocalizer = Relocalizer(views, next_view)

    def expected(self, mapper: Mapper) -> tuple[Index, Array] | None:
        """Now and then, the ended tracks that the last image should show, and where (pixels)."""
        last = mapper.images[-1] if mapper.images else None
        if last is None or not last.registered or len(mapper.images) % frames_in(_REVIVAL_SECONDS, mapper.frame_rate):
            return None
        return self._in_view(mapper, last)

    def keep_in_sight(self, mapper: Mapper, image: MappedImage, grey: NDArray[np.uint8]) -> None:
        """Find the view of the newest image again if it was lost, and take up the tracks whose points it shows.

        Args:
            grey: the image, (h, w).
        """
        if image.keyframe:
            self.relocalizer.remember(image.tracks.position, grey, image.tracks.ids, image.tracks.pixels)
        if not mapper.started or image.registered:
            return
        ids, rows = self.relocalizer.find(grey, image.tracks.pixels)
        if not mapper.relocalize(image, ids, image.tracks.xy[rows]):
            return
        image.take_up_tracks(*self._tracker.revive(grey, *self._in_view(mapper, image)))

    def _in_view(self, mapper: Mapper, image: MappedImage) -> tuple[Index, Array]:
        """Ended tracks with a point in front of an image, and where it is seen (pixels)."""
        ids, xy = visible(image, mapper.points, self._tracker.ended)
        return ids, pixels_from_normalized(image.tracks.camera, xy)
