"""Streams without an end: what lies far back keeps its pose, and what is needed to find its view again.

Frames beyond the horizon give up their observations. Of their keyframes those stay, with all that they saw, that show
what no older one shows: a camera that returns finds its landmarks there. Points that nothing sees any more are
forgotten. So memory, snapshots and the cost of a frame stop growing, but for the poses, as long as the camera stays
within the same surroundings; in new ones every second old view is given up again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.mapping.live_covariance import carried
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.result.frame_results import mapped_results
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.frame_update import SeenFrame
from factorsfm.streaming.relocalization import Relocalizer
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import Similarity, covariance_in_unit, pose_arrays

Array = NDArray[np.float64]

FRAMES = 4000  # of the default horizon: nearly three minutes of film, longer than shots are
_LEAST_FRAMES = 100
_CLEARINGS = 16  # in a horizon: what lies beyond is given up so often
_KEYFRAMES = 32  # that stay in any case: the graph works on them
_KNOWN = 0.5  # share of what a view shows that older ones show, above which it is given up
_MOST_VIEWS = 500  # from beyond the horizon: about 30 MB
_FAR = 0.5  # of the largest distance of a camera from the first one, beyond which it tells the unit of length


@dataclass(slots=True)
class Horizon:
    """What a stream has given up.

    Attributes:
        frames: how many keep their observations, None for all.
        begin: position of the first of them.
        views: positions of the keyframes before it that keep theirs, ascending.

    Raises:
        InputError: fewer frames than the graph needs.
    """

    frames: int | None
    begin: int = 0
    views: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < _LEAST_FRAMES:
            raise InputError(f"a horizon of {self.frames} frames is too near; at least {_LEAST_FRAMES} are needed")

    def follow(self, mapper: Mapper, relocalizer: Relocalizer) -> None:
        """After a frame, now and then: give up what lies beyond, but for what factors of the caller are about."""
        count = len(mapper.images)
        if self.frames is None or mapper.additions.taken or mapper.additions.offered:
            return
        if count <= self.frames or count % (self.frames // _CLEARINGS):
            return
        before = self.begin
        self.begin = max(before, count - self.frames)
        self._choose_views(mapper, [k for k in mapper.keyframes if before <= k < self.begin])
        stay = {*self.views, *mapper.keyframes[-_KEYFRAMES:]}
        for image in mapper.images[: self.begin]:
            if image.tracks.position not in stay and len(image.tracks.ids):
                image.tracks = replace(image.tracks.of(np.zeros(0, np.intp)), depth=None)
        relocalizer.keep([view for view in relocalizer.views if view.position >= self.begin or view.position in stay])
        mapper.points.keep(np.concatenate([image.tracks.ids for image in mapper.images]))

    def _choose_views(self, mapper: Mapper, left: Sequence[int]) -> None:
        """Of the keyframes that have just left, those that show something new."""
        views = list(self.views)
        known = [mapper.images[k].tracks.ids for k in views]
        for k in left:
            ids = mapper.images[k].tracks.ids
            if not known or np.isin(ids, np.concatenate(known)).mean() < _KNOWN:
                views.append(k)
                known.append(ids)
        self.views = tuple(views if len(views) <= _MOST_VIEWS else views[::2])

    def with_all(
        self, result: Reconstruction, frames: Sequence[SeenFrame], images: Sequence[MappedImage]
    ) -> Reconstruction:
        """A result of the frames within the horizon with all others before them, which keep their live poses.

        It is moved into the world of the live poses, in which it begins where these are; the unit is the result's.
        """
        if not self.begin or self.frames is None:
            return result
        found, live = result.frames, mapped_results(frames, images)
        both = [k for k, frame in enumerate(found) if frame.registered and live[self.begin + k].registered]
        if not both:
            return result
        anchor = images[self.begin + both[0]]
        to_live = _alignment([found[k] for k in both], [live[self.begin + k] for k in both])
        unit = 1.0 / to_live.scale
        translation = unit * to_live.translation
        result = in_other_world(result, Similarity(1.0, to_live.rotation, translation))
        for frame in result.frames:
            if frame.covariance is not None and frame.cam_from_world is not None and anchor.covariance is not None:
                first = anchor.pose[0], unit * anchor.pose[1]
                pose = frame.cam_from_world.rotation.matrix(), frame.cam_from_world.translation
                frame.covariance = frame.covariance + carried(covariance_in_unit(anchor.covariance, unit), first, pose)
        result.frames = [
            *(_kept(frame, image.covariance, unit) for frame, image in zip(live, images[: self.begin], strict=False)),
            *result.frames,
        ]
        result.observation_frame = result.observation_frame + self.begin
        result.notes.append(
            f"The stream is longer than its horizon of {self.frames} frames: those before frame "
            f"{frames[self.begin].index} keep the poses of the live graph, the others are polished."
        )
        return result


def recent(images: Sequence[MappedImage], begin: int) -> list[MappedImage]:
    """The images from a position on, counted from there."""
    if not begin:
        return list(images)
    return [replace(image, tracks=replace(image.tracks, position=k)) for k, image in enumerate(images[begin:])]


def _alignment(found: Sequence[FrameResult], live: Sequence[FrameResult]) -> Similarity:
    """Takes polished frames to their live poses: the first one exactly, the size by all others."""
    turns, centers = pose_arrays([frame.cam_from_world for frame in found])
    live_turns, live_centers = pose_arrays([frame.cam_from_world for frame in live])
    steps = [np.linalg.norm(c - c[0], axis=1) for c in (centers, live_centers)]
    far = steps[0] > _FAR * steps[0].max()
    scale = float(np.median(steps[1][far] / steps[0][far])) if far.any() else 1.0
    rotation = live_turns[0] @ turns[0].T
    return Similarity(scale, rotation, live_centers[0] - scale * rotation @ centers[0])


def _kept(frame: FrameResult, covariance: Array | None, unit: float) -> FrameResult:
    """A frame beyond the horizon, in another unit of length."""
    if (pose := frame.cam_from_world) is None:
        return frame
    return replace(
        frame,
        message=f"beyond the horizon; {frame.message}",
        cam_from_world=pycolmap.Rigid3d(pose.rotation, unit * pose.translation),
        covariance=None if covariance is None else covariance_in_unit(covariance, unit),
    )
