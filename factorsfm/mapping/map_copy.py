"""What an update of the map starts from, and what it gives: copies that cross to another process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.added_factors import NOTHING_ADDED, AddedFactors
from factorsfm.mapping.graph_window import taking_part
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import MapperOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Result of an update.

    Attributes:
        position: of the new keyframe; depth: its prior.
        committed, reason: whether the map may take it over, and why not.
        ids, points: moved and new points; removed: points that no longer hold.
        poses, affines, covariances: of the keyframes that moved, by position.
        focal: a better focal length (pixels), None where it stays as it is.
        burn_ins: tracks of what is laid over the images.
        moving: how many tracks move by themselves, so that the map begins again without them.
        at_odds: see `share_at_odds`; None where it was not asked.
        begins_again: whether it does, without those or, while it is young, without burn-ins: poses before are as wrong
            as it was.
        mirrored: see `UpdateResult`.
        unit: how many times as long lengths are now, all others of the map included.
        added: the caller's factors as the next update needs them; offered: how many of those that waited were tried;
            refused: why these were not taken; misfit: which of them is grossly off all the same.
        no_prior: whether the keyframes show that the depth prior is none; `reason` says why.
    """

    position: int
    depth: ImageDepth | None
    committed: bool
    reason: str
    ids: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    removed: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    poses: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    affines: dict[int, tuple[float, float]] = field(default_factory=dict)
    covariances: dict[int, Array] = field(default_factory=dict)
    focal: float | None = None
    burn_ins: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    moving: int = 0
    at_odds: float | None = None
    begins_again: bool = False
    mirrored: bool = False
    no_prior: bool = False
    unit: float = 1.0
    added: AddedFactors | None = None
    offered: int = 0
    refused: str = ""
    misfit: str = ""

    @property
    def note(self) -> str:
        """What became of the map, where that is out of the ordinary."""
        if not self.begins_again:
            return ""
        count, what = (self.moving, "move by themselves") if self.moving else (len(self.burn_ins), "rest in the image")
        return f"{count} tracks {what}, the map begins again without them"


@dataclass(frozen=True, slots=True)
class MapCopy:
    """What an update starts from: copies that nobody else changes.

    Attributes:
        keyframes: in order of time, the new one last.
        focal: pixels; refine_focal: whether it is a guess.
        added: the caller's factors that the graph has taken; offered: those that wait.
        unit: how many times as long lengths are as when the map began; unit_held: whether the factors determine it.
        asks_odds: whether `share_at_odds` is wanted.
    """

    keyframes: list[MappedImage]
    points: PointMap
    options: MapperOptions
    focal: float
    refine_focal: bool = False
    added: AddedFactors = NOTHING_ADDED
    offered: tuple[AddedFactors, ...] = ()
    unit: float = 1.0
    unit_held: bool = False
    asks_odds: bool = False

    @property
    def newest(self) -> MappedImage:
        """The new keyframe."""
        return self.keyframes[-1]

    def read_depth(self, read: Callable[[], ImageDepth | None]) -> None:
        """Give the new keyframe its prior, unless it has one."""
        if self.newest.tracks.depth is None:
            self.newest.tracks = replace(self.newest.tracks, depth=read())

    def without_prior(self) -> MapCopy:
        """The same as if there were no prior."""
        bare = [replace(image, tracks=replace(image.tracks, depth=None)) for image in self.keyframes]
        return replace(self, keyframes=bare)

    def scaled(self, unit: float, added: AddedFactors, *, unit_held: bool) -> MapCopy:
        """An independent copy with all lengths `unit` times as long, and all of the caller's factors as taken."""
        keyframes = [replace(image) for image in self.keyframes]
        for image in keyframes:
            image.scale(unit)
        return replace(
            self, keyframes=keyframes, points=self.points.scaled(unit), added=added, offered=(),
            unit=self.unit * unit, unit_held=unit_held,
        )  # fmt: skip

    @property
    def named_frames(self) -> set[int]:
        """The keyframes that the caller's factors name."""
        return self.added.frames.union(*(added.frames for added in self.offered))

    def needed(self) -> MapCopy:
        """As much of it as makes a difference to an update, which does not grow with the length of the shot."""
        before, free = taking_part(self.keyframes, self.named_frames)
        keyframes = before + free
        named = np.array(sorted(self.added.tracks.union(*(added.tracks for added in self.offered))), np.int64)
        points = self.points.part(np.unique(np.concatenate([named, *(image.tracks.ids for image in keyframes)])))
        return replace(self, keyframes=keyframes, points=points)
