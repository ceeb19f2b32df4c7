"""What a stream keeps of a frame, and what it says of it right after it was pushed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.frames.texture import BLANK_TEXTURE
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.result.frame_results import pose_of
from factorsfm.support.status import FrameStatus


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """What a stream keeps of a frame: never its pixels. `texture`: see `TrackedFrame`."""

    index: int
    name: str
    timestamp: float | None
    texture: float


@dataclass(frozen=True, slots=True)
class KeyframePrior:
    """Scale and shift of a keyframe's depth map beside the map, in the prior's unit: ``scale / z + shift``."""

    index: int
    scale: float
    shift: float


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """What is known of a frame right after it was pushed.

    Attributes:
        index: of the frame; status, message: see `FrameResult`.
        cam_from_world: pose now, causal; None where the frame is not registered.
        keyframe: whether the graph has been given it.
        tracks, inliers: tracked points, and those that agree with the pose.
        new_points: points that the map gained since the frame before.
        parallax: largest camera displacement so far over the median depth of the points seen.
        covariance: (6, 6) of the pose (see `FrameResult`), the uncertainty of the map included; None without a pose.
        prior: the newest depth map that the graph has used, None as long as there is none.
        at_odds: share of the image that no point of the map explains, as it was asked last: it moves by itself, or,
            where it is much (a quarter or more; `note` says so), it is the scene and the map is of what moves.
        dropped: frames that a live source dropped right before this one.
        shot: number of the shot in an `Episode`.
        focal_length: pixels, as the stream has it now; focal_changed: whether this frame changed it.
        starts_anew: whether all poses that were given before are void: with this frame the map was given up, or began
            again without what had bent it while it was young. `note` says why.
        note: one sentence on what became of the map with this frame, where that is out of the ordinary: a start that
            was given up or begins again without what moves by itself, a depth prior without which the stream goes on,
            much that is at odds with the map; else empty.
        repeats: index of the frame whose image this one shows once more, and whose pose it has; None if it is new.
    """

    index: int
    status: FrameStatus
    message: str
    cam_from_world: pycolmap.Rigid3d | None
    keyframe: bool
    tracks: int
    inliers: int
    new_points: int = 0
    parallax: float = 0.0
    covariance: NDArray[np.float64] | None = None
    prior: KeyframePrior | None = None
    at_odds: float = 0.0
    dropped: int = 0
    shot: int = 0
    focal_length: float = float("nan")
    focal_changed: bool = False
    starts_anew: bool = False
    note: str = ""
    repeats: int | None = None


class FrameIndices:
    """Indices that name the variables of frames: their own, or the next free one where another frame has that."""

    def __init__(self, taken: Iterable[int] = ()) -> None:
        self._taken = set(taken)

    def take(self, index: int) -> int:
        """The index for the next frame, by its own."""
        if index in self._taken or index < 0:
            index = max(self._taken, default=-1) + 1
        self._taken.add(index)
        return index


def frame_update(
    frame: Frame, image: MappedImage, mapper: Mapper, frames: Sequence[SeenFrame], *, focal_changed: bool
) -> FrameUpdate:
    """What is known of the newest frame; `image` is that of the mapper, `frames` are all that came."""
    news = mapper.news
    return FrameUpdate(
        frame.index, image.status, image.message, pose_of(image), image.keyframe, len(image.tracks.ids),
        image.inliers, news.points, mapper.parallax, image.covariance, _newest_prior(mapper, frames),
        mapper.at_odds, frame.dropped, focal_length=mapper.focal, focal_changed=focal_changed,
        starts_anew=news.starts_anew or news.begins_again, note=news.note,
    )  # fmt: skip


def repeated_update(frame: Frame, last: FrameUpdate) -> FrameUpdate:
    """What is known of a frame that shows the image of the last one once more: the same."""
    return replace(
        last, index=frame.index, message=f"repeats frame {last.index}: {last.message}", keyframe=False, new_points=0,
        dropped=frame.dropped, focal_changed=False, starts_anew=False, note="", repeats=last.index,
    )  # fmt: skip


def keyframe_times(images: Sequence[MappedImage], frames: Sequence[SeenFrame]) -> dict[int, float | None]:
    """Timestamps of the keyframes, by the index that names them."""
    pairs = zip(images, frames, strict=True)
    return {image.tracks.frame: frame.timestamp for image, frame in pairs if image.keyframe}


def mark_blank(mapper: Mapper, position: int, texture: float) -> None:
    """Where an image without texture is not registered, that is the reason to give."""
    if texture < BLANK_TEXTURE:
        contrast = f"contrast {texture:.2f} of {BLANK_TEXTURE:.2f} needed grey levels"
        mapper.explain(position, FrameStatus.BLANK, contrast)


def _newest_prior(mapper: Mapper, frames: Sequence[SeenFrame]) -> KeyframePrior | None:
    if mapper.without_prior:
        return None
    for position in reversed(mapper.keyframes):
        affine, depth = mapper.images[position].affine, mapper.images[position].tracks.depth
        if affine is not None and depth is not None:
            return KeyframePrior(frames[position].index, affine[0] * depth.unit, affine[1] * depth.unit)
    return None
