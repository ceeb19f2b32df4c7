"""When and how the map of a video starts: lifted by the prior, from the paper's pair, or without depth."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.starts import NoStart, Start, start_essential_among, start_flat, start_lifted, start_pair
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import MapperOptions
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks, shared_tracks

logger = logging.getLogger(__name__)

_PAIR_WINDOW = 10  # images among which the paper's initial pair is sought
NOT_JOINED = (FrameStatus.LOST, FrameStatus.TOO_FEW_INLIERS)
_PATIENCE = 5  # images that do not join a map, with which one is given up that has barely started:
_FEW_KEYFRAMES, _FEW_JOINED = 2, 6  # it has so few keyframes, or a quarter of a second of images has joined it
_LIFT_PATIENCE = 10  # images without a usable depth map after which the start does without


class Starter:
    """The start that the options ask for, or the one that is possible.

    Attributes:
        kind: see `MapperOptions.initialization`; "essential" where there is no prior.
    """

    def __init__(self, options: MapperOptions, *, has_prior: bool) -> None:
        self._options = options
        self.kind: str = options.initialization if has_prior else "essential"

    def try_start(
        self, waiting: Sequence[MappedImage], focal: float, read_depth: Callable[[], ImageDepth | None]
    ) -> Start | NoStart:
        """A start from the images that wait for one, the newest last.

        Args:
            focal: pixels.
            read_depth: gives the prior at the keypoints of the newest; called only if it is needed.
        """
        newest = waiting[-1]
        if self.kind == "lifted":
            newest.tracks = replace(newest.tracks, depth=read_depth())
            start = start_lifted(newest.tracks, self._options.min_tracks)
            if isinstance(start, NoStart) and len(waiting) >= _LIFT_PATIENCE:
                logger.warning("no usable depth in %d images, starting without: %s", _LIFT_PATIENCE, start.reason)
                self.kind = "essential"
            return start
        if self.kind == "pair":
            if len(waiting) < _PAIR_WINDOW:
                return NoStart(f"{len(waiting)} of {_PAIR_WINDOW} images among which the start is chosen")
            return self._pair(_tracks(waiting), focal)
        return self._essential(_tracks(waiting), focal, self._options.essential_angle_deg)

    def last_resort(self, waiting: Sequence[MappedImage], focal: float) -> Start | NoStart:
        """Where no more images come: with little parallax, or with none, rather than not at all."""
        tracks = _tracks(waiting)
        start = self._pair(tracks, focal) if self.kind == "pair" else NoStart("")
        if isinstance(start, NoStart):
            start = self._essential(tracks, focal, 0.0)
        return start_flat(tracks) if isinstance(start, NoStart) else start

    def _pair(self, tracks: list[ImageTracks], focal: float) -> Start | NoStart:
        o = self._options
        return start_pair(tracks, o.min_tracks, focal=focal, sigma=o.pixel_sigma, inlier_px=o.inlier_px)

    def _essential(self, tracks: list[ImageTracks], focal: float, angle_deg: float) -> Start | NoStart:
        o = self._options
        return start_essential_among(tracks, o.min_tracks, focal=focal, sigma=o.pixel_sigma, angle_deg=angle_deg)


def _tracks(images: Sequence[MappedImage]) -> list[ImageTracks]:
    return [image.tracks for image in images]


def passed_by(images: Sequence[MappedImage], keyframes: int, min_tracks: int) -> bool:
    """Whether more images have failed to join the map than ever joined it, and share tracks among themselves.

    The map is of a flash then, of a whip pan, or of the end of the shot before. One that has grown is never given up.

    Args:
        images: in order of time; keyframes: number of those of the map.
        min_tracks: that two images share if they show the same scene.
    """
    joined = sum(image.registered for image in images)
    since = itertools.takewhile(lambda image: not image.registered, reversed(images))
    failed = [image.tracks for image in since if image.status in NOT_JOINED]
    barely_started = keyframes <= _FEW_KEYFRAMES or joined <= _FEW_JOINED
    if not barely_started or len(failed) <= max(_PATIENCE, joined):
        return False
    return shared_tracks(failed[0], failed[_PATIENCE]) >= min_tracks


def left_behind(images: Sequence[MappedImage]) -> str:
    """Let the images that did not join their map wait for another, and those that did lose it; says why.

    Args:
        images: in order of time.
    """
    joined = sum(image.registered for image in images)
    last = max(k for k, image in enumerate(images) if image.registered)
    for k, image in enumerate(images):
        if k > last and image.status in NOT_JOINED:
            image.forget(FrameStatus.WAITING, "waiting for the start of another map")
        elif image.registered:
            image.forget(FrameStatus.LOST, f"on a map of {joined} images that none of those that followed joined")
    return f"the images that follow image {last} do not join its map, starting anew"
