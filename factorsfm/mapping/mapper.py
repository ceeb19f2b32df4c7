"""The incremental mapper: start, register, triangulate, update the graph; one image at a time, in order of arrival."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.contents import LiveGraph
from factorsfm.graph.process import GraphProcess
from factorsfm.graph.unit_of_length import unit_of_length
from factorsfm.mapping.additions import Additions
from factorsfm.mapping.at_odds import EVERY, became_much
from factorsfm.mapping.graph_updates import GraphUpdates
from factorsfm.mapping.incremental import IncrementalMapper
from factorsfm.mapping.keyframes import carry, is_keyframe, suddenly_rough, update_delay
from factorsfm.mapping.landmarks import map_tracks
from factorsfm.mapping.live_covariance import live_covariance
from factorsfm.mapping.map_contents import MapContents
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_news import MapNews
from factorsfm.mapping.map_registration import register_by_corners
from factorsfm.mapping.mapped_images import MappedImage, nearest_registered
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.prior_trust import PriorTrust
from factorsfm.mapping.registration import Registration
from factorsfm.mapping.starter import NOT_JOINED, Starter, left_behind, passed_by
from factorsfm.mapping.starts import NoStart, Start
from factorsfm.mapping.young_map import YOUNG_KEYFRAMES
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import Options
from factorsfm.support.pace import USUAL_RATE
from factorsfm.support.parallax import parallax
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_STATE = ("focal", "first_focal", "keyframes", "parallax", "started", "unit", "at_odds")
_RUNNING_OUT = 0.45  # share of an image's tracks with a point, below which the map is extended at once


class Mapper(IncrementalMapper):
    """Depth-guided incremental structure from motion over tracks.

    Args:
        graph: that of the keyframes, closed with the mapper.
        focal: pixels; width: of the image, pixels.
        options: steps, thresholds and weights; has_prior: whether a depth prior exists at all; without one the start is
            the essential matrix.
    """

    def __init__(self, graph: GraphProcess, focal: float, width: int, options: Options, *, has_prior: bool) -> None:
        super().__init__([], focal, options)
        self.width, self.started, self.frame_rate = width, False, USUAL_RATE
        self.keyframes: list[int] = []
        self.parallax, self.at_odds = 0.0, 0.0  # largest so far; see `share_at_odds`
        self.news = MapNews()  # since the image before
        self.unit = 1.0  # how many times as long lengths are as when the map began
        self.additions = Additions()
        self._updates = GraphUpdates(graph)
        self._advanced = -1  # number of images for which `advance` was called last
        self._starter = Starter(self.options, has_prior=has_prior)
        self._reads_every_depth = has_prior and (
            self._starter.kind == "pair" or self.options.registration_depth != "none"
        )
        self._prior = PriorTrust(has_prior and options.uses_depth)

    # --- the algorithm --------------------------------------------------------------------------------------------

    def add(
        self, tracks: ImageTracks, read_depth: Callable[[], ImageDepth | None], *, keyframe: bool = False
    ) -> MappedImage:
        """Take the next image: register it on the map, and extend the map where it shows something new.

        Args:
            read_depth: gives the prior at the image's keypoints; called only if it is needed.
            keyframe: whether it becomes a keyframe also where it shows nothing new, if it is registered.
        """
        if self._reads_every_depth:
            tracks = replace(tracks, depth=read_depth())
        self.advance()
        image = MappedImage(tracks, FrameStatus.WAITING, "waiting for the start of the map")
        self.images.append(image)
        try:
            self._process(image, read_depth)
            if keyframe and image.registered and not image.keyframe:
                self._take_over()
                if image.registered:  # on a map that was not given up
                    self._add_keyframe(image, read_depth)
        except Exception:  # a prior that fails, before anything changed: the image was never here
            self.images.pop()
            raise
        return image

    def _process(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None]) -> None:
        if len(image.tracks.ids) < self.options.min_tracks:
            image.status = FrameStatus.TOO_FEW_TRACKS
            image.message = f"{len(image.tracks.ids)} of {self.options.min_tracks} needed tracks"
        elif not self.started:
            self._try_start(read_depth)
        else:
            self._extend(image, read_depth)
            if not image.registered and passed_by(self.images, len(self.keyframes), self.options.min_tracks):
                self._start_anew()
                self._try_start(read_depth)

    def _extend(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None]) -> None:
        """Register an image, and extend the map where it shows something new."""
        hurry = self.points.contains(image.tracks.ids).mean() < _RUNNING_OUT
        if hurry:  # the camera is faster than the graph
            self._take_over()
        if not self.started:
            self._try_start(read_depth)
            return
        self._register(image)
        if not image.registered and map_tracks(image, self.images, self.points, self.options, self.focal):
            self._register(image)
        if image.registered and not self._updates.pending and self._is_keyframe(image):
            self._add_keyframe(image, read_depth)
            if hurry:
                self._take_over()

    # --- start ----------------------------------------------------------------------------------------------------

    def _waiting(self) -> list[MappedImage]:
        return [image for image in self.images if image.status is FrameStatus.WAITING]

    def _try_start(self, read_depth: Callable[[], ImageDepth | None]) -> None:
        self._begin(self._starter.try_start(self._waiting(), self.focal, read_depth))

    def _begin(self, start: Start | NoStart) -> None:
        if isinstance(start, NoStart):
            for image in self._waiting():
                image.message = start.reason
            return
        self.started = True
        self.news.points = len(start.ids)
        waiting = self._waiting()
        for image in self._accept_start(start):
            self._add_keyframe(image, None)
            self._take_over()
        if len(start.images) == 1:
            image.message = f"the start of a map of {len(start.ids)} points, which no other image has joined yet"
        # Next image as COLMAP chooses it: the one that sees most of the map.
        remaining = [image for image in waiting if not image.registered]
        while remaining and self.started:
            image = max(remaining, key=lambda i: int(self.points.contains(i.tracks.ids).sum()))
            remaining.remove(image)
            self._register(image)
            if image.registered and self._is_keyframe(image):
                self._add_keyframe(image, None)
                self._take_over()

    def _start_anew(self) -> None:
        """Forget the map; the images that did not join it wait for another."""
        self._take_over()
        self._give_up_map(left_behind(self.images))

    def _give_up_map(self, reason: str) -> None:
        self._updates.start_anew()
        self.points, self.keyframes, self.started = PointMap(), [], False
        self.parallax, self.at_odds = 0.0, 0.0
        if self.additions.taken or self.additions.offered:
            reason += "; the factors added are given up with it"
        self.additions, self.unit = Additions(), 1.0
        self.news.starts_anew, self.news.note = True, reason
        logger.warning(reason)

    # --- registration ---------------------------------------------------------------------------------------------

    def _register(self, image: MappedImage) -> None:
        near = image if image.registered else nearest_registered(self.images, image.tracks.position)
        self._register_near(image, near, in_order=True)

    def relocalize(self, image: MappedImage, ids: Index, xy: Array) -> bool:
        """Register an image by what its descriptors say that it shows; whether that worked.

        Args:
            ids: (n,) tracks that look like corners of the image; xy: (n, 2) these corners, normalised.
        """
        near = nearest_registered(self.images, image.tracks.position)
        result, agree = register_by_corners(ids, xy, self.points, near, self.focal, self.options)
        if result is None:
            image.message += f"; not found again: {agree}" if agree else ""
            return False
        self._accept(image, replace(result, inliers=np.zeros(len(image.tracks.ids), bool)))
        image.inliers, image.rough = int(result.inliers.sum()), False
        image.message = f"found again: {agree}"
        return True

    def _accept(self, image: MappedImage, found: Registration) -> None:
        super()._accept(image, found)
        image.rough = suddenly_rough(image, self.images, len(self.keyframes))
        image.covariance = live_covariance(image, found.covariance, self.images, self.keyframes)
        inverse = self.points.inverse_depths(image, found.inliers)
        if len(inverse):  # the first camera is the world
            moved = np.stack([np.zeros(3), image.pose[0].T @ image.pose[1]])
            self.parallax = max(self.parallax, parallax(moved, inverse))

    def forget_tracks(self, ids: Index) -> None:
        """Leave some tracks out of the images before the newest, which the graph may be working on."""
        for image in self.images[:-1]:
            image.forget_tracks(ids)

    # --- keyframes and landmarks ----------------------------------------------------------------------------------

    def _is_keyframe(self, image: MappedImage) -> bool:
        last, count = self.images[self.keyframes[-1]].tracks, len(self.keyframes)
        return is_keyframe(
            image.tracks, last, count, self.focal, self.width, self.options, rate=self.frame_rate, rough=image.rough
        )

    def _add_keyframe(self, image: MappedImage, read_depth: Callable[[], ImageDepth | None] | None) -> None:
        """Let the graph work on the keyframe; the map takes over its result after a while."""
        keyframes = [replace(self.images[k]) for k in self.keyframes] + [replace(image)]
        copy = MapCopy(
            keyframes, self.points.copy(), self.options, self.focal, self._refine_focal,
            added=self.additions.active, offered=tuple(self.additions.offered), unit=self.unit,
            asks_odds=len(keyframes) % EVERY == 0,
        )  # fmt: skip
        if self._prior.lost:
            copy = copy.without_prior()
        delay = update_delay(len(self.keyframes), self.options, self.frame_rate)
        read = read_depth if self._prior.active else None
        self._updates.begin(copy, read, due=len(self.images) - 1 + delay)
        image.keyframe = True

    def advance(self) -> None:
        """Before the next image: take over what the graph has made of a keyframe, if that is due."""
        if self._advanced == len(self.images):
            return
        self._advanced = len(self.images)
        self.news = MapNews()
        if self._updates.is_due(len(self.images)):
            self._take_over()

    def _take_over(self) -> None:
        """Wait for the graph, and take over the map as it sees it now."""
        update = self._updates.taken()
        if update is None:
            return
        image = self.images[update.position]
        if image.tracks.depth is None and update.depth is not None:
            image.tracks = replace(image.tracks, depth=update.depth)
        if self._prior.lose(update):
            self._go_on_without_prior()
        if not self.started:
            return
        if self.keyframes and self._prior.waits(update):
            image.keyframe = False
            return
        self._prior.missing = 0
        if not update.committed:
            image.keyframe = False
            return
        self.keyframes.append(update.position)
        at_odds = self.at_odds if update.at_odds is None else update.at_odds
        said = self.news.note, self.additions.follow(update) or update.note, became_much(self.at_odds, at_odds)
        self.at_odds = at_odds
        self.news.note = "; ".join(filter(None, said))
        self.news.begins_again |= update.begins_again
        if update.unit != 1.0:
            self._rescale(update.unit)
        before = image.pose
        self.news.points += int((~self.points.contains(update.ids)).sum())
        self._accept_update(update)
        self.news.burn_ins = np.union1d(self.news.burn_ins, update.burn_ins)
        carry(image, before, self.images[update.position + 1 :])
        if update.focal is not None:
            self._set_focal(update.focal)

    def _rescale(self, unit: float) -> None:
        """Go on with all lengths `unit` times as long."""
        self.unit *= unit
        self.points = self.points.scaled(unit)
        for image in self.images:
            image.scale(unit)

    # --- without the prior ----------------------------------------------------------------------------------------

    @property
    def without_prior(self) -> str:
        """Why the depth prior takes no part any more, empty while it does."""
        return self._prior.lost

    def _go_on_without_prior(self) -> None:
        """Leave the prior out from now on. A young map has the shape that the prior gave it, and is given up."""
        self._starter.kind = "essential"
        note = self.news.note = f"going on without the depth prior: {self._prior.lost}"
        if len(self.keyframes) > YOUNG_KEYFRAMES:
            logger.warning(note)
            return
        for image in self.images:
            if image.registered or image.status in NOT_JOINED:
                image.forget(FrameStatus.WAITING, "waiting for a start without the depth prior")
        self._give_up_map(f"{note}; starting anew")

    # --- the last image -------------------------------------------------------------------------------------------

    def finish(self, last_factors: Callable[[Mapper], None] = lambda mapper: None) -> None:
        """No more images: start with what there is, if nothing better came; all images on the map as it is at last.

        Args:
            last_factors: may add factors to the map as the last keyframe left it.
        """
        self._take_over()
        if not self.started:
            self._begin(self._starter.last_resort(self._waiting(), self.focal))
        last_factors(self)
        if self.additions.offered:  # no update will take them: the polish does
            self._rescale(unit_of_length(self.additions.everything(), self.contents())[0])
        self.refresh()
        self._take_up_lost()
        self.close()

    def refresh(self) -> None:
        """Register the images between the keyframes once more, on the map as it is now."""
        self._take_over()
        for image in self.images:
            if image.registered and not image.keyframe:
                known = image.status, image.message
                self._register(image)
                if image.status is not FrameStatus.REGISTERED:
                    image.status, image.message = known

    def _take_up_lost(self) -> None:
        """Register what the map had lost, or not reached yet, from its ends and gaps on: backwards, then forwards."""
        if not self.started:
            return
        found = True
        while found:
            found = False
            for image in itertools.chain(reversed(self.images), self.images):
                if image.registered or image.status not in NOT_JOINED:
                    continue
                known = image.status, image.message
                map_tracks(image, self.images, self.points, self.options, self.focal)
                self._register(image)
                if image.registered:
                    found = True
                else:
                    image.status, image.message = known

    def close(self) -> None:
        """Let the graph go; what it is working on is lost."""
        self._updates.close()

    # --- the graph, and factors of the caller ---------------------------------------------------------------------

    def graph(self) -> LiveGraph:
        """A copy of the keyframe graph as the last update left it, empty before the first one."""
        return self._updates.contents()

    def contents(self) -> MapContents:
        """Poses, affines and landmarks by frame and track."""
        return MapContents(self.images, self.points)

    def add_factors(self, graph: object, values: object) -> None:
        """Let the next update of the graph take factors of the caller; errors as in `checked_factors`."""
        keyframes = [image for image in self.images if image.keyframe]  # and the one that the graph is working on
        self.additions.offer(graph, values, MapContents(keyframes, self.points))

    # --- snapshots ------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs; waits for what the graph is working on."""
        return {
            **{name: getattr(self, name) for name in _STATE},
            "start_kind": self._starter.kind,
            "prior": [self._prior.lost, self._prior.mirrored, self._prior.missing],
            "images": list(self.images),
            "points": self.points.all(),
            "additions": self.additions.state(),
            **self._updates.state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken. The graph is rebuilt from the map at its next update."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._starter.kind = state["start_kind"]
        self._prior = PriorTrust(self._prior.wanted, *state["prior"])
        self.images = list(state["images"])
        self.points = PointMap()
        self.points.set(*state["points"])
        self.additions.restore(state["additions"])
        self._updates.restore(state)
