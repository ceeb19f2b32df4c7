"""Points of the control that are marked by tracks of the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from factorsfm.control.known import Control, FrameKey, MarkedPoint, Vector
from factorsfm.tracks.image_tracks import ImageTracks
from factorsfm.tracks.supervised import SupervisedTracks


def marked_by_tracks(control: Control, images: Sequence[ImageTracks], supervised: SupervisedTracks) -> Control:
    """The control in which points without pixels have those of the supervised tracks of their names."""
    known = dict(
        zip(supervised.names, zip(supervised.ids.tolist(), supervised.sigma.tolist(), strict=True), strict=True)
    )

    def marked(point: MarkedPoint) -> MarkedPoint:
        if point.pixels is not None or point.name not in known:
            return point
        track, sigma = known[point.name]
        pixels: dict[FrameKey, Vector] = {i.frame: i.pixels[i.ids == track][0] for i in images if track in i.ids}
        return replace(point, pixels=pixels, pixel_sigma=sigma)

    return replace(control, points=[marked(point) for point in control.points])
