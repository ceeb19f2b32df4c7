"""Points of the control that are marked by tracks of the user."""

from __future__ import annotations

from collections.abc import Collection, Sequence
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


def without_tracked(control: Control, names: Collection[str]) -> Control | None:
    """The control without the points that tracks of these names mark, and what refers to them; None: nothing is left.

    Raises:
        InputError: what is left does not determine where the scene is.
    """
    points = [point for point in control.points if point.pixels is not None or point.name not in names]
    gone = {point.name for point in control.points} - {point.name for point in points}
    distances = [distance for distance in control.distances if not gone & {*distance.points}]
    heights = [height for height in control.heights if not gone & {*height.above}]
    if not (control.poses or distances or heights or any(point.position is not None for point in points)):
        return None
    return replace(control, points=points, distances=distances, heights=heights)
