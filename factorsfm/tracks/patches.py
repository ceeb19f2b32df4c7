"""Birth patches: what surrounds tracks at their first appearance, aligned with later frames through affine maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.tracks.parts import in_parts
from factorsfm.tracks.tiles import (
    cut_tiles,
    has_exposure_changed,
    inner_tiles,
    match_tile_exposure,
    nearest_pixels,
    tile_atlas,
    warp_tiles,
)

Array = NDArray[np.float32]
Image = NDArray[np.uint8]
Rows = NDArray[np.intp]

_PATCH_HALF_PX = 22  # of the side of a stored patch: the window at half the scale of the birth, with its margin
_MARGIN_PX = 1  # of a warped patch around the window, for interpolation and derivatives
_STALE_PX = 0.07  # change of the map at the edge of the window, above which a patch is warped again
_STOP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
_FORWARD_CRITERIA = (_STOP, 20, 0.01)
_BACKWARD_CRITERIA = (_STOP, 5, 0.03)  # coarse: it only has to tell whether the way back ends where it began
_LEAST_PASSED = 0.7  # share of the checked alignments that pass; with fewer, the others are checked, too

_IMAGES, _MAPS = ("_patches", "_warped"), ("_affine", "_warped_by")  # arrays in slots, and in the order of the tracks


class BirthPatches:
    """The birth patch of every track, and the affine map that takes it to the present frame.

    Args:
        window_px: side of the Lucas-Kanade window.
    """

    def __init__(self, window_px: int) -> None:
        self._window = (window_px, window_px)
        self._half = window_px // 2 + _MARGIN_PX
        side, warped_side = 2 * _PATCH_HALF_PX + 1, 2 * self._half + 1
        # The large arrays have slots, so that they are not copied at every frame; a track knows its slot.
        self._slots = np.zeros(0, np.intp)
        self._patches = np.zeros((0, side, side), np.uint8)
        self._warped = np.zeros((0, warped_side, warped_side), np.uint8)
        self._affine = np.zeros((0, 2, 2), np.float32)  # present frame from birth patch
        self._warped_by = np.zeros((0, 2, 2), np.float32)  # the map with which a patch was warped last
        self._warping: list[Future[None]] = []

    def add(self, grey: Image, xy: Array) -> None:
        """Add tracks that are born in a frame (h, w), at pixels (n, 2)."""
        patches = cut_tiles(grey, xy, _PATCH_HALF_PX)
        unit = np.tile(np.eye(2, dtype=np.float32), (len(xy), 1, 1))
        inner = slice(_PATCH_HALF_PX - self._half, _PATCH_HALF_PX + self._half + 1)
        self._join({"_patches": patches, "_warped": patches[:, inner, inner], "_affine": unit, "_warped_by": unit})

    def take(self, rows: NDArray[np.bool_] | Rows) -> BirthPatches:
        """A copy of the patches of some of the tracks."""
        taken = BirthPatches(self._window[0])
        taken._join(self._of(rows))
        return taken

    def append(self, other: BirthPatches) -> None:
        """Add the tracks of `other` behind the own ones."""
        self._join(other.state())

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything that `restore` needs."""
        return self._of(slice(None))

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `state` was taken."""
        self.keep(slice(0))
        self._join(state)

    def keep(self, index: NDArray[np.bool_] | Rows | slice) -> None:
        """Keep some of the tracks, or all in another order."""
        self._wait()
        for name in ("_slots", *_MAPS):
            setattr(self, name, getattr(self, name)[index])

    def _of(self, index: NDArray[np.bool_] | Rows | slice) -> dict[str, NDArray[Any]]:
        self._wait()
        images = {name: getattr(self, name)[self._slots[index]] for name in _IMAGES}
        return {**images, **{name: getattr(self, name)[index] for name in _MAPS}}

    def _join(self, tracks: Mapping[str, NDArray[Any]]) -> None:
        """Add tracks, in free slots as far as there are any."""
        self._wait()
        count = len(tracks["_affine"])
        missing = count - (len(self._patches) - len(self._slots))
        if missing > 0:
            more = max(missing, len(self._patches) // 2)
            for name in _IMAGES:
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), np.uint8)]))
        free = np.ones(len(self._patches), bool)
        free[self._slots] = False
        slots = np.flatnonzero(free)[:count]
        for name in _IMAGES:
            getattr(self, name)[slots] = tracks[name]
        self._slots = np.r_[self._slots, slots]
        for name in _MAPS:
            setattr(self, name, np.concatenate([getattr(self, name), tracks[name]]))

    def move(self, linear: Array) -> None:
        """Update the maps by the local motion to the next frame: the linear parts of it at the tracks, (n, 2, 2)."""
        self._affine = linear @ self._affine

    def warp_ahead(self, pool: ThreadPoolExecutor) -> None:
        """Begin to warp the patches for the next frame, in the background."""
        self._wait()
        self._warping = [pool.submit(self._warp, rows) for rows in np.array_split(np.arange(len(self._affine)), 2)]

    def _wait(self) -> None:
        """Wait until no patch is being warped; before that, nothing may change."""
        for part in self._warping:
            part.result()
        self._warping.clear()

    def align(
        self,
        grey: Image,
        rows: Rows,
        start: Array,
        check_px: float,
        reach_px: float,
        pool: ThreadPoolExecutor,
        checked: NDArray[np.bool_] | None = None,
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Align the warped patches of some tracks with a frame.

        Args:
            grey: (h, w) the frame.
            rows: (n,) of the tracks.
            start: (n, 2) pixels where they should be.
            check_px: largest forward-backward error.
            reach_px: largest distance from `start`.
            checked: (n,) which of them get the forward-backward check; None checks all. The others get it, too, if many
                of these fail.

        Returns:
            (n, 2) pixels, and whether each is within reach and passes its check.
        """
        if not len(rows):
            return start, np.zeros(0, bool)
        self._wait()
        self._warp(rows)
        checked = np.ones(len(rows), bool) if checked is None else checked

        def part(index: Rows) -> tuple[Array, NDArray[np.bool_]]:
            return self._align(grey, rows[index], start[index], check_px, reach_px, checked[index])

        return in_parts(part, len(rows), pool)

    def _align(
        self, grey: Image, rows: Rows, start: Array, check_px: float, reach_px: float, checked: NDArray[np.bool_]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Only what lies around the tracks is looked at: to prepare all of a large frame costs more than the rest."""
        pixel = nearest_pixels(start, grey.shape)
        tiles, seen = self._warped[self._slots[rows]], cut_tiles(grey, start, self._half + math.ceil(reach_px) + 1)
        seen_inner = inner_tiles(seen, self._half)
        if has_exposure_changed(tiles, seen_inner):  # matched only then, since it costs a little accuracy
            tiles = match_tile_exposure(tiles, seen_inner)
        atlas, centers = tile_atlas(tiles, seen.shape[1])
        frame, _ = tile_atlas(seen, seen.shape[1])
        inside = np.abs(start - pixel).max(axis=1) <= 1.0
        first = centers + np.where(inside[:, None], start - pixel, 0.0).astype(np.float32)
        aligned, status, _ = cv2.calcOpticalFlowPyrLK(
            atlas, frame, centers, first.copy(), winSize=self._window, maxLevel=0, criteria=_FORWARD_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        good = inside & (status[:, 0] == 1) & (np.linalg.norm(aligned - first, axis=1) < reach_px)

        def passes(index: Rows) -> NDArray[np.bool_]:
            """The forward-backward check."""
            back, status, _ = cv2.calcOpticalFlowPyrLK(
                frame, atlas, aligned[index], centers[index], winSize=self._window, maxLevel=0,
                criteria=_BACKWARD_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            return np.asarray((status[:, 0] == 1) & (np.linalg.norm(back - centers[index], axis=1) < check_px))

        some, rest = np.nonzero(good & checked)[0], np.nonzero(good & ~checked)[0]
        if len(some):
            good[some] = passes(some)
        if len(rest) and (not len(some) or good[some].mean() < _LEAST_PASSED):
            good[rest] = passes(rest)
        return np.asarray(aligned - first + start, np.float32), good

    def _warp(self, rows: Rows) -> None:
        """Warp the patches again whose map has changed."""
        change_px = np.abs(self._affine[rows] - self._warped_by[rows]).sum(axis=2).max(axis=1) * self._half
        stale = rows[change_px > _STALE_PX]
        if not len(stale):
            return
        slots = self._slots[stale]
        self._warped[slots] = warp_tiles(self._patches[slots], self._affine[stale], self._half)
        self._warped_by[stale] = self._affine[stale]
