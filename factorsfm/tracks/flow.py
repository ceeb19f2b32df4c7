"""Tracks from video: pyramidal Lucas-Kanade, re-aligned against the patch of each track's first appearance.

Chained optical flow drifts, and in a shot with little parallax the drift is as large as the signal. So every track
keeps the patch around its first appearance and the affine map that carries this patch into the current frame
(followed from frame to frame with the local motion of its neighbours). After each flow step the patch is warped with
that map and aligned with the current frame once more, which cancels the drift without any model of the scene.
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
from factorsfm.tracks.grey import GreyFrame, exposed_as
from factorsfm.tracks.local_motion import LocalMotion
from factorsfm.tracks.patches import Array, BirthPatches, in_parts

_STATE = (
    "_texture", "_frame", "_replenished", "_next_id", "_ids", "_xy", "_velocity", "_ended", "_away_until", "_avoided",
)  # fmt: skip
_MOST_ENDED = 3000  # tracks that are remembered
_AWAY = 48  # frames: only of a camera that comes back tracks are taken up that have left the view
_REVIVAL_REACH = 2.0  # times that of a re-alignment: where a track should be is known less well
_SCOUTS = 64  # tracks that tell how the camera's motion has changed
_FIT_STEPS, _FIT_RIDGE = 5, 1e-4
_SURPRISE_PX, _SURPRISE_RATIO = 0.5, 3.0  # distance from the predicted place; and times that of the others
_GRID = 24  # cells along the longer image side, from which new corners are taken in turn
_CHECK_INTERVAL = 2  # frames: the way back of an alignment is tried in turn
_REPLENISH_INTERVAL, _FEW = 3, 0.7  # frames between looking for corners, unless so small a share of the tracks is left
_MOST = 0.5  # share of the tracks that are where they should be, or all are looked for from scratch
_BLANK_SHARE = 0.2  # of the texture of the last frame; with less, a frame among others is black or a flash


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Tracks alive in one frame.

    Attributes:
        ids: (n,) identities, never reused; none in a frame that is blank beside the one before.
        xy: (n, 2) pixels, centres at integers.
        lost: tracks that ended here.
        born: tracks that start here.
        texture: standard deviation of the Laplacian at the scale of a feature (grey levels), a measure of blankness.
    """

    ids: NDArray[np.int64]
    xy: NDArray[np.float64]
    lost: int
    born: int
    texture: float


class FlowTracker(Closing):
    """Follows image points through a video, one frame at a time, in bounded memory."""

    def __init__(self, options: TrackerOptions) -> None:
        self.options = options
        self._previous: GreyFrame | None = None
        self._texture = 0.0  # of the previous image
        self._frame = 0
        self._replenished = 0  # the frame in which tracks were started last
        self._next_id = 0
        self._ids = np.zeros(0, np.int64)
        self._xy = np.zeros((0, 2), np.float32)
        self._velocity = np.zeros((0, 2), np.float32)
        self._motion: LocalMotion | None = None  # into the present frame
        self._avoided = np.zeros((0, 2), np.float32)  # places where no track may start
        self._patches = BirthPatches(options.window_px)
        self._window = (options.window_px, options.window_px)
        self._just_ended: list[tuple[NDArray[np.int64], NDArray[np.int64], BirthPatches]] = []
        self._ended = np.zeros(0, np.int64)
        self._away_until = np.zeros(0, np.int64)  # frame from which an ended track can be taken up again
        self._ended_patches = BirthPatches(options.window_px)
        self._pool = ThreadPoolExecutor(2)

    def track(
        self,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None = None,
        expected: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
    ) -> TrackedFrame:
        """Follow all tracks into `image` and start new ones where the image is not covered.

        Args:
            image: (h, w, 3) BGR or (h, w) grey.
            mask: (h, w), True where nothing may be tracked.
            expected: ended tracks that are in view again, see `revive`; they come before new ones.
        """
        grey = np.ascontiguousarray(image) if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        frame = GreyFrame.of(grey)
        texture = frame.texture
        if texture < _BLANK_SHARE * self._texture:  # the tracks wait for the next frame that shows something
            return TrackedFrame(np.zeros(0, np.int64), np.zeros((0, 2)), 0, 0, texture)
        before = len(self._ids)
        if self._previous is not None and before:
            self._step(self._previous, frame, mask)
        lost = before - len(self._ids)
        if expected is not None:
            self.revive(grey, *expected)
        born = self._replenish(frame, mask)
        self._previous, self._texture = frame, texture
        self._frame += 1
        self._patches.warp_ahead(self._pool)
        return TrackedFrame(self._ids.copy(), self._xy.astype(np.float64), lost, born, texture)

    def close(self) -> None:
        """Let the threads go; no further image can be tracked."""
        self._pool.shutdown()

    def avoid(self, ids: NDArray[np.int64]) -> None:
        """End tracks of what is laid over the images, and start none in these places again."""
        gone = np.isin(self._ids, ids)
        if gone.any():
            self._avoided = np.r_[self._avoided, self._xy[gone]]
            self._keep(~gone)

    @property
    def ended(self) -> NDArray[np.int64]:
        """Tracks that can be taken up again: they were lost together with most others, or left the view a while ago."""
        self._gather_ended()
        return self._ended[self._away_until <= self._frame]

    def revive(
        self, image: NDArray[np.uint8], ids: NDArray[np.int64], xy: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Take up ended tracks in the image just tracked, where their patch is found; those, and where (pixels).

        Args:
            image: (h, w) grey, the last one tracked.
            ids: (n,) of ended tracks; xy: (n, 2) where they should be (pixels).
        """
        inside = np.isfinite(xy).all(axis=1) & _inside(np.nan_to_num(xy), image.shape, self.options.border_px)
        if not inside.any():
            return np.zeros(0, np.int64), np.zeros((0, 2))
        order = np.argsort(self._ended)
        rows = order[np.searchsorted(self._ended, ids[inside], sorter=order)]
        o = self.options
        found, good = self._ended_patches.align(
            image,
            rows,
            xy[inside].astype(np.float32),
            o.realign_check_px,
            _REVIVAL_REACH * o.realign_reach_px,
            self._pool,
        )
        good &= _inside(found, image.shape, o.border_px)
        rows, found = rows[good], found[good]
        revived = self._ended[rows]
        self._ids = np.r_[self._ids, revived]
        self._xy = np.r_[self._xy, found]
        self._velocity = np.r_[self._velocity, self._usual_velocity(found)]
        self._patches.append(self._ended_patches.take(rows))
        self._keep(np.argsort(self._ids))
        rest = np.ones(len(self._ended), bool)
        rest[rows] = False
        self._keep_ended(rest)
        return np.asarray(revived), found.astype(np.float64)

    def _end(self, rows: NDArray[np.intp], away_until: int) -> None:
        """Put tracks aside, not to be taken up before a frame."""
        if len(rows):
            self._just_ended.append((self._ids[rows], np.full(len(rows), away_until), self._patches.take(rows)))

    def _gather_ended(self) -> None:
        """Join what was put aside lately with the rest; the oldest are forgotten where there are too many."""
        for ids, away_until, patches in self._just_ended:
            self._ended = np.r_[self._ended, ids]
            self._away_until = np.r_[self._away_until, away_until]
            self._ended_patches.append(patches)
        self._just_ended.clear()
        if len(self._ended) > _MOST_ENDED:
            self._keep_ended(slice(-_MOST_ENDED, None))

    def _keep_ended(self, index: NDArray[np.bool_] | slice) -> None:
        self._ended = self._ended[index]
        self._away_until = self._away_until[index]
        self._ended_patches.keep(index)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        self._gather_ended()
        previous = self._previous.full if self._previous is not None else None
        arrays = {name: getattr(self, name) for name in _STATE}
        return {**arrays, "previous": previous, "patches": self._patches.state(), "ended": self._ended_patches.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        for name in _STATE:
            setattr(self, name, state[name])
        previous = state["previous"]
        self._previous = GreyFrame.of(previous) if previous is not None else None
        self._patches.restore(state["patches"])
        self._ended_patches.restore(state["ended"])

    def _keep(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> None:
        self._ids = self._ids[index]
        self._xy = self._xy[index]
        self._velocity = self._velocity[index]
        self._patches.keep(index)

    def _step(self, previous: GreyFrame, frame: GreyFrame, mask: NDArray[np.bool_] | None) -> None:
        """Align the patches where their tracks should be; search in the frame before for those that are not there."""
        o, old, n, grey = self.options, self._xy, len(self._ids), frame.full
        previous = exposed_as(previous, frame)
        start = self._predicted(previous, frame)
        checked = (self._ids + self._frame) % _CHECK_INTERVAL == 0
        new, ok = self._patches.align(
            grey, np.arange(n), start, o.realign_check_px, o.realign_reach_px, self._pool, checked
        )
        surprise = np.linalg.norm(new - start, axis=1)
        if ok.any():
            ok &= surprise < max(_SURPRISE_PX, _SURPRISE_RATIO * np.median(surprise[ok]))
        search = np.nonzero(~ok)[0]
        known = start[search] if ok.mean() > _MOST else None  # where most are lost, so is the prediction
        new[search], ok[search] = self._search(previous, frame, old[search], known)
        self._motion = LocalMotion(old[ok], new[ok], grey.shape)
        linear = np.tile(np.eye(2, dtype=np.float32), (n, 1, 1))
        linear[ok] = self._motion.linear(old[ok])
        self._patches.move(linear)
        again = search[ok[search]]
        if len(again):
            new[again], ok[again] = self._patches.align(
                grey, again, new[again], o.realign_check_px, o.realign_reach_px, self._pool
            )
        place = np.where(ok[:, None], new, start)
        gone = ~_inside(place, grey.shape, o.border_px)
        if mask is not None:
            gone |= _at(mask, place)
        self._xy, self._velocity = new, new - old
        self._end(np.nonzero(gone)[0], self._frame + _AWAY)
        if ok.mean() <= _MOST:  # what is lost alone slid along an edge, mostly, and would do so again
            self._end(np.nonzero(~ok & ~gone)[0], self._frame)
        ok &= ~gone
        self._keep(np.nonzero(ok)[0])

    def _usual_velocity(self, xy: Array) -> Array:
        """How fast points should be that were not followed into this frame: as fast as their neighbours."""
        return np.zeros_like(xy) if self._motion is None else self._motion.at(xy)

    def _predicted(self, previous: GreyFrame, frame: GreyFrame) -> Array:
        """Where tracks should be: as fast as before, and with the camera's change of motion, which a few tell."""
        predicted = self._xy + self._velocity
        scouts = np.linspace(0, len(predicted) - 1, min(len(predicted), _SCOUTS)).astype(int)
        found, seen = self._roughly(previous, frame, self._xy[scouts])
        scouts = scouts[seen]
        # Affine in the image as a rotation is nearly, and in the motion before, in which parallax shows.
        scale = np.array([1.0, *([1.0 / max(frame.full.shape)] * 4)])
        cause = np.column_stack([np.ones(len(predicted)), self._xy, self._velocity]) * scale
        change = _robust_fit(cause[scouts], found[seen] - predicted[scouts])
        return np.asarray(predicted + cause @ change, np.float32)

    def _roughly(
        self, previous: GreyFrame, frame: GreyFrame, xy: Array, start: Array | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Flow of points in the images of half the size, and where there is any: near `start`, or anywhere."""
        first = None if start is None else (start - 0.5) / 2
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            previous.half, frame.half, (xy - 0.5) / 2, first, winSize=self._window,
            maxLevel=self.options.levels - 1 if start is None else 1, criteria=_COARSE,
            flags=0 if start is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        return 2 * found + 0.5, status[:, 0] == 1

    def _search(
        self, previous: GreyFrame, frame: GreyFrame, xy: Array, start: Array | None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Flow of points, and whether the way back, tried from where it should end, stays there.

        Args:
            start: where the points may be; None: anywhere.
        """

        def part(rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
            old = xy[rows]
            rough, _ = self._roughly(previous, frame, old, None if start is None else start[rows])
            forward, status, _ = cv2.calcOpticalFlowPyrLK(
                previous.full, frame.full, old, rough, winSize=self._window, maxLevel=0, criteria=_COARSE,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            back, status_back, _ = cv2.calcOpticalFlowPyrLK(
                frame.full, previous.full, forward, old.copy(), winSize=self._window, maxLevel=1, criteria=_COARSE,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            ok = (status[:, 0] == 1) & (status_back[:, 0] == 1)
            ok &= np.linalg.norm(back - old, axis=1) < self.options.flow_check_px
            return forward, ok

        return in_parts(part, len(xy), len(xy), self._pool) if len(xy) else (xy, np.zeros(0, bool))

    def _replenish(self, frame: GreyFrame, mask: NDArray[np.bool_] | None) -> int:
        """Start tracks where the image is not covered, strongest corners first in every cell."""
        o = self.options
        room = o.max_tracks - len(self._ids)
        if room < o.max_tracks * o.replenish_below:
            return 0
        if len(self._ids) > _FEW * o.max_tracks and self._frame - self._replenished < _REPLENISH_INTERVAL:
            return 0
        self._replenished = self._frame
        # Corners are sought in the image of half the size: where exactly a patch lies does not matter.
        h, w = frame.half.shape
        border = -(-o.border_px // 2)
        free = np.zeros((h, w), np.uint8)
        free[border : h - border, border : w - border] = 255
        if mask is not None:
            free[mask[: 2 * h : 2, : 2 * w : 2] | mask[1 : 2 * h : 2, 1 : 2 * w : 2]] = 0
        radius = max(2, round(0.4 * (w * h / o.max_tracks) ** 0.5))
        for x, y in (0.5 * self._xy - 0.25).round().astype(int).tolist():
            cv2.circle(free, (x, y), radius, 0, -1)
        for x, y in (0.5 * self._avoided - 0.25).round().astype(int).tolist():
            cv2.circle(free, (x, y), o.window_px // 2, 0, -1)
        corners = cv2.goodFeaturesToTrack(frame.half, 0, o.corner_quality, radius, mask=free, blockSize=3)
        if corners is None:
            return 0
        corners = _spread(2.0 * np.rint(corners[:, 0]), room, frame.full.shape)
        m = len(corners)
        self._ids = np.r_[self._ids, np.arange(self._next_id, self._next_id + m)]
        self._next_id += m
        self._xy = np.r_[self._xy, corners].astype(np.float32)
        self._velocity = np.r_[self._velocity, self._usual_velocity(corners)]
        self._patches.add(frame.full, corners)
        return m


_STOP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
_COARSE = (_STOP, 12, 0.02)  # from frame to frame: the re-alignment does the rest


def _robust_fit(cause: NDArray[np.float64], effect: Array) -> NDArray[np.float64]:
    """(c, 2) coefficients with ``cause @ coefficients ~ effect`` where most rows agree; zero where hardly any is there.

    Args:
        cause: (n, c) of size one; effect: (n, 2) pixels.
    """
    rows, columns = cause.shape
    solution: NDArray[np.float64] = np.zeros((columns, 2))
    weight = np.ones(rows)
    for _ in range(_FIT_STEPS if rows >= 2 * columns else 0):
        weighted = cause * weight[:, None]
        normal = weighted.T @ cause + _FIT_RIDGE * np.eye(columns)
        solution = np.asarray(np.linalg.solve(normal, weighted.T @ effect), np.float64)
        error = np.linalg.norm(cause @ solution - effect, axis=1)
        weight = 1.0 / (1.0 + (error / max(float(np.sort(error)[rows // 2]), _SURPRISE_PX)) ** 2)
    return solution


def _inside(xy: NDArray[np.floating[Any]], shape: tuple[int, ...], border: int) -> NDArray[np.bool_]:
    h, w = shape[:2]
    return (xy > border - 1).all(axis=1) & (xy[:, 0] < w - border) & (xy[:, 1] < h - border)


def _at(mask: NDArray[np.bool_], xy: Array) -> NDArray[np.bool_]:
    h, w = mask.shape
    x = np.clip(np.rint(xy[:, 0]).astype(int), 0, w - 1)
    y = np.clip(np.rint(xy[:, 1]).astype(int), 0, h - 1)
    return np.asarray(mask[y, x], bool)


def _spread(corners: Array, count: int, shape: tuple[int, ...]) -> Array:
    """The strongest `count` corners, taken in turn from the cells of a grid (corners come strongest first)."""
    if len(corners) <= count:
        return corners
    cell_px = max(shape[:2]) / _GRID
    cell = (corners // cell_px).astype(int)
    key = cell[:, 1] * (_GRID + 1) + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[0, np.nonzero(np.diff(key[order]))[0] + 1]
    rank = np.arange(len(key)) - np.repeat(first, np.diff(np.r_[first, len(key)]))
    turn = np.empty(len(key), int)
    turn[order] = rank
    return corners[np.argsort(turn, kind="stable")[:count]]
