"""Tracks from video: pyramidal Lucas-Kanade, re-aligned with the patch of each track's first appearance.

Chained optical flow drifts, and in a shot with little parallax the drift is as large as the signal. So every track
keeps its birth patch, which is cut from the frame of its first appearance, and the affine map that takes this patch to
the present frame. At every frame

1. the flow of a few tracks predicts all of them;
2. the birth patches, warped by their maps, are aligned with the frame at the predicted places, which cancels the drift
   without a model of the scene;
3. tracks that are not found there are searched by flow from the previous frame, and re-aligned;
4. the local motion of the found tracks updates the maps;
5. tracks end that were not found, left the image or entered the mask, and new ones start where the image has room.

Flow and corners are sought in an image of bounded size, and the birth patches aligned in the full image, of which only
what lies around the tracks is looked at: the cost hardly grows with the size of the image, and the errors are the same
in pixels. So thresholds are in pixels: what they bound is the noise of a sensor and the reach of a window.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.context import Closing
from factorsfm.support.options import TrackerOptions
from factorsfm.support.pace import USUAL_RATE, frames_in
from factorsfm.tracks.corners import new_corners
from factorsfm.tracks.frame_flow import FrameFlow, robust_fit
from factorsfm.tracks.grey import GreyFrame, match_exposure
from factorsfm.tracks.local_motion import LocalMotion
from factorsfm.tracks.patches import BirthPatches
from factorsfm.tracks.track_rows import EndedTracks, LiveTracks

Array = NDArray[np.float32]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]

_BLANK_SHARE = 0.2  # texture over that of the previous frame, below which a frame is black or a flash
_CHECK_INTERVAL = 2  # frames: the alignment of every track is checked backward in one of them
_SURPRISE_PX, _SURPRISE_RATIO = 0.5, 3.0  # largest distance from the prediction, and the same over the median distance
_OTHERWISE_PX, _OTHERWISE_RATIO = 2.0, 5.0  # least distance from the motion of the image, and the same over the median
_MAJORITY = 0.5  # share of the tracks that are found; with fewer, the prediction is wrong
_AWAY_SECONDS = 2.0  # after which a track that left the view may be revived: only a camera that returns sees it again
_INTERRUPTION_SECONDS = 0.5  # for which a lost view is expected back: a flash, a foreign frame, damage, a hand
_REVIVAL_REACH = 2.0  # times that of a re-alignment: the place of a revived track is less certain
_REPLENISH_SECONDS = 0.125  # between two searches for corners ...
_REPLENISH_SHARE = 0.7  # ... unless a smaller share of `max_tracks` is alive


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The tracks of one frame.

    Attributes:
        ids: (n,) identities, never used again; empty if the frame is blank beside the previous one.
        xy: (n, 2) pixels, centres at integers.
        texture: standard deviation of the Laplacian at the scale of a feature (grey levels); near 0 in a blank frame.
    """

    ids: NDArray[np.int64]
    xy: NDArray[np.float64]
    texture: float


@dataclass(frozen=True, slots=True)
class _LostView:
    """A frame before most tracks were lost at once, and those n tracks: what follows may be a mere interruption.

    Attributes:
        frame, texture: what was seen. ids: (n,); xy: (n, 2) pixels there; velocity: (n, 2) pixels per frame.
        lost_at: number of the frame in which they were lost.
    """

    frame: GreyFrame
    texture: float
    ids: NDArray[np.int64]
    xy: Array
    velocity: Array
    lost_at: int

    def state(self) -> dict[str, Any]:
        """Everything that `restored` needs."""
        plain = {name: getattr(self, name) for name in ("texture", "ids", "xy", "velocity", "lost_at")}
        return {"frame": self.frame.reduced, **plain}

    @staticmethod
    def restored(state: Mapping[str, Any]) -> _LostView:
        """That of which `state` was taken."""
        return _LostView(**{**state, "frame": GreyFrame.of(state["frame"])})


class FlowTracker(Closing):
    """Follows image points through a video, one frame at a time, in bounded memory.

    Attributes:
        frame_rate: of the video, frames a second.
    """

    def __init__(self, options: TrackerOptions) -> None:
        self.options, self.frame_rate = options, USUAL_RATE
        self._previous: GreyFrame | None = None
        self._texture = 0.0  # of the previous frame
        self._frame = 0
        self._replenished = 0  # the frame in which corners were searched last
        self._next_id = 0
        self._tracks = LiveTracks(options.window_px)
        self._ended = EndedTracks(options.window_px)
        self._lost_view: _LostView | None = None
        self._avoided = np.zeros((0, 2), np.float32)  # pixels where no track may start
        self._motion: LocalMotion | None = None  # from the previous frame to the present one
        self._pool = ThreadPoolExecutor(2)
        self._flow = FrameFlow(options, self._pool)

    def track(
        self,
        image: Image,
        mask: Flags | None = None,
        expected: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
    ) -> TrackedFrame:
        """Follow all tracks into a frame, and start new ones where it has room.

        Args:
            image: (h, w, 3) BGR or (h, w) grey.
            mask: (h, w), True where nothing may be tracked.
            expected: arguments of `revive`, which comes before new tracks start.
        """
        grey = np.ascontiguousarray(image) if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        frame = GreyFrame.of(grey)
        texture = frame.texture
        if self._is_blank(texture):  # the tracks wait for the next frame that shows something
            return TrackedFrame(np.zeros(0, np.int64), np.zeros((0, 2)), texture)
        if self._previous is not None and len(self._tracks):
            self._follow(self._previous, frame, mask)
        if self._lost_view is not None:
            self._look_for(self._lost_view, frame)
        if expected is not None:
            self.revive(grey, *expected)
        self._replenish(frame, mask)
        self._previous, self._texture = frame, texture
        self._frame += 1
        self._tracks.patches.warp_ahead(self._pool)
        return TrackedFrame(self._tracks.ids.copy(), self._tracks.xy.astype(np.float64), texture)

    def close(self) -> None:
        """Let the threads go; no further image can be tracked."""
        self._pool.shutdown()

    def avoid(self, ids: NDArray[np.int64]) -> None:
        """End tracks on captions and logos, and start none in these places again."""
        burnt_in = np.isin(self._tracks.ids, ids)
        if burnt_in.any():
            self._avoided = np.r_[self._avoided, self._tracks.xy[burnt_in]]
            self._tracks.keep(~burnt_in)

    @property
    def ended(self) -> NDArray[np.int64]:
        """Ids of the tracks that may be revived: most others were lost with them, or they left the view a while ago."""
        return self._ended.ready(self._frame)

    def revive(
        self, image: Image, ids: NDArray[np.int64], xy: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Continue ended tracks whose birth patch is found in the frame tracked last.

        Args:
            image: that frame, (h, w) grey.
            ids: (n,) of ended tracks.
            xy: (n, 2) pixels where they should be.

        Returns:
            The ids of the tracks that are alive again, (m,), and their pixels, (m, 2).
        """
        good, found = self._found_again(image, ids, xy.astype(np.float32))
        self._take_up(ids[good], found[good], self._local_velocity(found[good]))
        return np.asarray(ids[good]), found[good].astype(np.float64)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        return {
            "texture": self._texture,
            "frame": self._frame,
            "replenished": self._replenished,
            "next_id": self._next_id,
            "avoided": self._avoided,
            "previous": self._previous.reduced if self._previous is not None else None,
            "tracks": self._tracks.state(),
            "ended": self._ended.state(),
            "lost_view": self._lost_view.state() if self._lost_view is not None else None,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self._texture, self._frame = state["texture"], state["frame"]
        self._replenished, self._next_id = state["replenished"], state["next_id"]
        self._avoided = state["avoided"]
        self._previous = GreyFrame.of(state["previous"]) if state["previous"] is not None else None
        self._tracks.restore(state["tracks"])
        self._ended.restore(state["ended"])
        self._lost_view = _LostView.restored(state["lost_view"]) if state["lost_view"] is not None else None

    def _follow(self, previous: GreyFrame, frame: GreyFrame, mask: Flags | None) -> None:
        """Steps 1 to 4: predict, re-align, search, and update the maps of the patches; end what is not found."""
        tracks, old, shown = self._tracks, self._tracks.xy, previous
        previous = match_exposure(previous, frame)
        predicted = self._flow.predict(previous, frame, old, tracks.velocity)
        checked = (tracks.ids + self._frame) % _CHECK_INTERVAL == 0
        new, found = self._realign(frame, np.arange(len(tracks)), predicted, checked)
        surprise = np.linalg.norm(new - predicted, axis=1)
        if found.any():
            found &= surprise < max(_SURPRISE_PX, _SURPRISE_RATIO * np.median(surprise[found]))
        missing = np.nonzero(~found)[0]
        near = predicted[missing] if found.mean() > _MAJORITY else None
        new[missing], found[missing] = self._flow.search(previous, frame, old[missing], near)
        self._move_patches(old, new, found, frame.full.shape)
        searched = missing[found[missing]]
        if len(searched):
            new[searched], found[searched] = self._realign(frame, searched, new[searched])
        if found.mean() <= _MAJORITY and self._lost_view is None:
            gone = ~found
            self._lost_view = _LostView(
                shown, self._texture, tracks.ids[gone], old[gone], tracks.velocity[gone], self._frame
            )
        tracks.xy, tracks.velocity = new, new - old
        self._end(found, np.where(found[:, None], new, predicted), frame.full.shape, mask)

    def _realign(self, frame: GreyFrame, rows: NDArray[np.intp], start: Array, *checked: Flags) -> tuple[Array, Flags]:
        """Align birth patches with a frame, see `BirthPatches.align`."""
        o = self.options
        align = self._tracks.patches.align
        return align(frame.full, rows, start, o.realign_check_px, o.realign_reach_px, self._pool, *checked)

    def _move_patches(self, old: Array, new: Array, found: Flags, shape: tuple[int, ...]) -> None:
        """Update the maps of the patches by the local motion of the found tracks."""
        linear = np.tile(np.eye(2, dtype=np.float32), (len(old), 1, 1))
        rows = np.nonzero(found)[0]
        odd = _moves_otherwise(old[rows], new[rows], max(shape))
        with_image, otherwise = rows[~odd], rows[odd]
        self._motion = LocalMotion(old[with_image], new[with_image], shape)
        linear[with_image] = self._motion.linear(old[with_image])
        if len(otherwise):
            linear[otherwise] = LocalMotion(old[otherwise], new[otherwise], shape).linear(old[otherwise])
        self._tracks.patches.move(linear)

    def _end(self, found: Flags, place: Array, shape: tuple[int, ...], mask: Flags | None) -> None:
        """End the tracks that are not found, outside the image or in the mask.

        Those that left may be revived later. So may those that were lost if most tracks were: then the view is lost. A
        track that is lost alone mostly slid along an edge and would do so again.
        """
        left = ~_inside(place, shape, self.options.border_px)
        if mask is not None:
            left |= _at(mask, place)
        self._put_aside(np.nonzero(left)[0], self._frame + frames_in(_AWAY_SECONDS, self.frame_rate))
        if found.mean() <= _MAJORITY:
            self._put_aside(np.nonzero(~found & ~left)[0], self._frame)
        self._tracks.keep(np.nonzero(found & ~left)[0])

    def _is_blank(self, texture: float) -> bool:
        """Whether a frame is black or a flash beside what was seen before, and not only beside an interruption."""
        view = self._lost_view
        return texture < _BLANK_SHARE * (self._texture if view is None else min(self._texture, view.texture))

    def _look_for(self, view: _LostView, frame: GreyFrame) -> None:
        """Take up the tracks of a view that was gone for a moment, if the frame shows most of them again."""
        since = self._frame - view.lost_at
        if since > frames_in(_INTERRUPTION_SECONDS, self.frame_rate):
            self._lost_view = None
        known = self._ended.holds(view.ids)
        if since == 0 or self._lost_view is None or not known.any():
            return
        ids, xy, velocity = view.ids[known], view.xy[known], view.velocity[known]
        place = self._flow.predict(match_exposure(view.frame, frame), frame, xy, velocity)
        good, found = self._found_again(frame.full, ids, place)
        if good.sum() <= _MAJORITY * len(view.ids):
            return
        self._motion = None  # that from the interruption to this frame means nothing
        self._take_up(ids[good], found[good], (found - xy)[good] / np.float32(since + 1))
        self._lost_view = None

    def _found_again(self, image: Image, ids: NDArray[np.int64], xy: Array) -> tuple[Flags, Array]:
        """Which ended tracks (n,) are near their places (n, 2) in an image, by their patches, and where (n, 2)."""
        o, found = self.options, xy.copy()
        good = np.isfinite(xy).all(axis=1) & _inside(np.nan_to_num(xy), image.shape, o.border_px)
        if good.any():
            reach_px, rows = _REVIVAL_REACH * o.realign_reach_px, self._ended.rows(ids[good])
            align = self._ended.patches.align
            found[good], aligned = align(image, rows, xy[good], o.realign_check_px, reach_px, self._pool)
            good[good] = aligned & _inside(found[good], image.shape, o.border_px)
        return good, found

    def _take_up(self, ids: NDArray[np.int64], xy: Array, velocity: Array) -> None:
        """Go on with ended tracks (n,), which are at pixels (n, 2)."""
        rows = self._ended.rows(ids)
        self._tracks.append(ids, xy, velocity, self._ended.patches.take(rows))
        self._tracks.keep(np.argsort(self._tracks.ids))
        self._ended.remove(rows)

    def _put_aside(self, rows: NDArray[np.intp], ready_from: int) -> None:
        if len(rows):
            self._ended.add(self._tracks.ids[rows], self._tracks.patches.take(rows), ready_from)

    def _replenish(self, frame: GreyFrame, mask: Flags | None) -> None:
        """Start tracks at new corners."""
        o, alive = self.options, len(self._tracks)
        room = o.max_tracks - alive
        if room < o.max_tracks * o.replenish_below:
            return
        interval = frames_in(_REPLENISH_SECONDS, self.frame_rate)
        if alive > _REPLENISH_SHARE * o.max_tracks and self._frame - self._replenished < interval:
            return
        self._replenished = self._frame
        corners = new_corners(frame, self._tracks.xy, self._avoided, mask, room, o)
        if len(corners):
            born = BirthPatches(o.window_px)
            born.add(frame.full, corners)
            ids = np.arange(self._next_id, self._next_id + len(corners))
            self._tracks.append(ids, corners, self._local_velocity(corners), born)
            self._next_id += len(corners)

    def _local_velocity(self, xy: Array) -> Array:
        """(n, 2) velocity of points that were not followed into this frame: that of their neighbours."""
        return np.zeros_like(xy) if self._motion is None else self._motion.at(xy)


def _moves_otherwise(old: Array, new: Array, size: int) -> Flags:
    """(n,) which tracks move unlike the image as a whole: their motion says nothing of the patches beside them.

    Args:
        old, new: (n, 2) pixels in two frames; size: of the image, pixels.
    """
    if not len(old):
        return np.zeros(0, bool)
    design = np.column_stack([np.ones(len(old)), old / size])
    error = np.linalg.norm(new - old - design @ robust_fit(design, new - old), axis=1)
    return np.asarray(error > max(_OTHERWISE_PX, _OTHERWISE_RATIO * float(np.median(error))))


def _inside(xy: NDArray[np.floating[Any]], shape: tuple[int, ...], border: int) -> Flags:
    """(n,) whether pixels (n, 2) keep the distance to the border of an image."""
    h, w = shape[:2]
    return (xy > border - 1).all(axis=1) & (xy[:, 0] < w - border) & (xy[:, 1] < h - border)


def _at(mask: Flags, xy: Array) -> Flags:
    """(n,) the mask at pixels (n, 2)."""
    h, w = mask.shape
    x = np.clip(np.rint(xy[:, 0]).astype(int), 0, w - 1)
    y = np.clip(np.rint(xy[:, 1]).astype(int), 0, h - 1)
    return np.asarray(mask[y, x], bool)
