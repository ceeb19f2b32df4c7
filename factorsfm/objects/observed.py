"""Objects as they are seen while the frames come: a tracker for each, and the depth prior at its tracks.

The scene is tracked without them, and each of them without the scene, in the same pass over the frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthModel, DepthPrior
from factorsfm.priors.depth_map import DepthMap
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.priors.masks import DEFAULT_MARGIN, MaskPrior, fitted
from factorsfm.priors.object_masks import ObjectMasks
from factorsfm.priors.read_priors import read_depth, read_mask, reported_failure
from factorsfm.support.context import Closing
from factorsfm.support.errors import InputError
from factorsfm.support.options import TrackerOptions
from factorsfm.tracks.colors import TrackColors
from factorsfm.tracks.flow import FlowTracker
from factorsfm.tracks.image_tracks import ImageTracks

# Of the tracks of an object, instead of 21: it has a rim of half a window in which no track may be. On boxes of 60
# pixels, windows of 21 that reach across the outline made one in two turn the wrong way; those of 15 inside made none.
_WINDOW_PX = 15

# Relative error of a network on a thing that it has never seen so, as a box in the air, however well the scene fits its
# maps. Of four boxes laid into three scenes TCMonoDepth makes the distance 0.67, 1.3, 1.5 and 2.2 times the true one.
_NETWORK_ON_THINGS = 0.4

_Seen = tuple[int, NDArray[np.int64], NDArray[np.float64], ImageDepth | None]


class RememberedDepth:
    """A depth prior that keeps the map of the newest frame for which it was asked, so that objects see it, too."""

    def __init__(self, prior: DepthPrior) -> None:
        self.name, self.kind = prior.name, prior.kind
        self.frame: int | None = None  # index of the frame whose map it has
        self.on_things = _NETWORK_ON_THINGS if isinstance(prior, DepthModel) else 0.0
        self._prior = prior
        self._map: DepthMap | None = None

    def __call__(self, frame: Frame) -> DepthMap | None:
        """That of the prior."""
        if frame.index != self.frame:
            self.frame, self._map = None, self._prior(frame)
            self.frame = frame.index
        return self._map


@dataclass(slots=True)
class _Observed:
    tracker: FlowTracker
    colors: TrackColors = field(default_factory=TrackColors)
    frames: list[_Seen] = field(default_factory=list)


class ObservedObjects(Closing):
    """The objects of a shot; call it for the mask of the scene, then `push` the same frame.

    Args:
        objects: their masks.
        masks: what else the scene ignores, or None.
        depth: that of the scene, whose maps are read on the objects, too; None without a prior.
    """

    def __init__(
        self, objects: ObjectMasks, masks: MaskPrior | None, depth: RememberedDepth | None, options: TrackerOptions
    ) -> None:
        self._objects, self._masks, self._depth = objects, masks, depth
        self._options = replace(options, window_px=_WINDOW_PX)
        self._held = ExitStack()
        self._observed: dict[str, _Observed] = {}
        self._present: dict[str, NDArray[np.bool_]] = {}
        self._count = 0

    def __call__(self, frame: Frame) -> NDArray[np.bool_] | None:
        """As a `MaskPrior`: all objects, and what is ignored otherwise."""
        with reported_failure("object", frame):
            self._present = self._objects(frame)
        ignored = read_mask(self._masks, frame)
        for name, mask in self._present.items():
            if mask.ndim != 2 or not mask.size:
                raise InputError(f"the mask of {name} in frame {frame.index} has shape {mask.shape}, expected (h, w)")
            grown = fitted(mask, frame, DEFAULT_MARGIN)
            ignored = grown if ignored is None else ignored | grown
        return ignored

    def push(self, frame: Frame) -> None:
        """Follow the objects into a frame that the scene has taken."""
        grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8)
        for name in self._present:
            if name not in self._observed:
                self._observed[name] = _Observed(self._held.enter_context(FlowTracker(self._options)))
        for name, seen in self._observed.items():
            mask = self._present.get(name, np.zeros((1, 1), bool))
            # The windows of its tracks lie inside: behind its outline the scene moves otherwise.
            margin = max(DEFAULT_MARGIN, (_WINDOW_PX // 2) / grey.shape[1])
            tracked = seen.tracker.track(grey, fitted(~mask, frame, margin))
            seen.colors.remember(frame.image, tracked.ids, tracked.xy)
            depth = None
            if self._depth is not None and self._depth.frame == frame.index and len(tracked.ids):
                depth = read_depth(self._depth, frame, tracked.xy)
            seen.frames.append((self._count, tracked.ids, tracked.xy, depth))
        self._count += 1

    @property
    def depth_on_things(self) -> float:
        """As `PriorOnScene.on_things`."""
        return self._depth.on_things if self._depth is not None else 0.0

    @property
    def names(self) -> list[str]:
        """Of all objects that were seen, sorted."""
        return sorted(self._observed)

    def tracks(self, name: str, cameras: Mapping[int, pycolmap.Camera]) -> list[ImageTracks]:
        """Of an object, in the frames that have a camera (by position)."""
        images = [
            ImageTracks(position, ids, pixels, cameras[position], depth)
            for position, ids, pixels, depth in self._observed[name].frames
            if position in cameras
        ]
        return [image.of(image.invertible) for image in images]

    def colors(self, name: str) -> NDArray[np.uint8]:
        """(n, 3) RGB of an object's tracks, by id."""
        return self._observed[name].colors.table

    def close(self) -> None:
        """Let the trackers go."""
        self._held.close()
