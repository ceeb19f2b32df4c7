"""Keyframes: which images become one, and how the images after one follow it when the graph moves it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.support.options import MapperOptions
from factorsfm.support.pace import frames_in
from factorsfm.support.rotations import nearest_rotation
from factorsfm.tracks.image_tracks import ImageTracks, median_flow, shared_tracks

Array = NDArray[np.float64]

_LEAST_SHARED = 0.7  # of the tracks of the last keyframe; with fewer, a new one is made
_SETTLED, _SETTLED_DELAY = 5, 1.0 / 12.0  # keyframes of a map that changes little; how much longer it waits, seconds
# Ratios of the spread of the errors, and of the share of tracks that agree, to those of the best of so many images
# before. In a map that changes little nearly all agree: there, that fewer do is enough.
# At 1.2 no image would pass: every one would be a keyframe.
_ROUGH, _CONTRADICTED, _LATELY = 1.5, 0.85, 5


def is_keyframe(
    image: ImageTracks, last: ImageTracks, count: int, focal: float, width: int, options: MapperOptions,
    *, rate: float, rough: bool,
) -> bool:  # fmt: skip
    """Whether an image shows enough beyond the last keyframe.

    Args:
        count: of the keyframes so far; focal, width: of the images, pixels; rate: frames a second.
        rough: whether the image fits suddenly worse, see `suddenly_rough`: then only where tracks run out.
    """
    if shared_tracks(image, last) < _LEAST_SHARED * len(last.ids):
        return True
    if rough:
        return False
    # A young map has the shape that the prior guessed: the first keyframes come soon. Of a camera that hardly moves,
    # ever fewer are needed.
    youth = min(1.0, 0.25 * count)
    interval = min(2 * count, frames_in(options.keyframe_seconds, rate)) * max(1, count // 10)
    return bool(
        median_flow(image, last) * focal > youth * options.keyframe_flow * width
        or image.position - last.position >= interval
    )


def update_delay(count: int, options: MapperOptions, rate: float) -> int:
    """How many frames after a keyframe the map takes over its update; arguments as in `is_keyframe`."""
    settled = _SETTLED_DELAY if count >= _SETTLED else 0.0
    return frames_in(options.graph_delay_seconds + settled, rate)


def suddenly_rough(image: MappedImage, images: Sequence[MappedImage], count: int) -> bool:
    """Whether a registered image fits the map far worse than those just before it.

    Fewer of its tracks agree, and in a young map not as well. A damaged, blurred or flashed image passes, and must not
    bend the map. Where the map itself is wrong, the images stay rough, and one of them becomes a keyframe.

    Args:
        images: all, in order of time, at least those before it.
        count: of the keyframes so far. With one, the map has the shape that the prior guessed, and all images are rough
            from the first parallax on.
    """
    position = image.tracks.position
    lately = [other for other in images[max(0, position - _LATELY) : position] if other.registered]
    if not lately or count < 2:
        return False
    if _agreeing(image) >= _CONTRADICTED * max(map(_agreeing, lately)):
        return False
    return count >= _SETTLED or image.threshold > _ROUGH * min(other.threshold for other in lately)


def _agreeing(image: MappedImage) -> float:
    """Share of its tracks with a point that agree with the pose of an image."""
    return image.inliers / max(image.mapped, 1)


def carry(keyframe: MappedImage, before: tuple[Array, Array], followers: Sequence[MappedImage]) -> None:
    """Move images with a keyframe: they were registered on the map of when it had the pose `before`."""
    rotation, translation = keyframe.pose
    for image in followers:
        if image.registered:
            turn, shift = image.pose
            relative = turn @ before[0].T
            # Rotations that stem from each other are alike in how far they are none: here it would be three times as
            # far, at every keyframe.
            image.rotation = nearest_rotation(relative @ rotation)
            image.translation = relative @ (translation - before[1]) + shift
