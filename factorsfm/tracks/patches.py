"""Patches around the first appearance of tracks, aligned with later frames through affine maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Image = NDArray[np.uint8]
Rows = NDArray[np.intp]

_SUPPORT = 22  # half side of a stored patch: the window at half the birth's scale, with its margin
_MARGIN = 1  # of a warped patch around the window: interpolation and derivative
_STALE_PX = 0.07  # change of the map at the edge of the window with which a patch is warped again
_EXPOSURE_CHANGE = 4.0  # grey levels, of the typical patch; without one it is up to 1.2, in fast motion more
_WITNESSES = 64  # patches that tell of it
_MOST_GAIN = 4.0  # of the contrast, between a patch and the image
_STOP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
_FINE = (_STOP, 20, 0.01)
_ALL_GOOD = 0.7  # share of the checked ones that must come back, or the others are checked, too
_BACK = (_STOP, 5, 0.03)  # the way back only has to tell whether it ends where it began

_WORTH_TWO = 250  # tracks; for fewer, preparing the images twice takes longer than following half of them

_LARGE, _SMALL = ("_patches", "_warped"), ("_affine", "_warped_by")


class BirthPatches:
    """The patch of every track's first appearance and the affine map that carries it into the current frame.

    Args:
        window_px: side of the Lucas-Kanade window.
    """

    def __init__(self, window_px: int) -> None:
        self._window = (window_px, window_px)
        self._half = window_px // 2 + _MARGIN
        side, tile = 2 * _SUPPORT + 1, 2 * self._half + 1
        self._slots = np.zeros(0, np.intp)  # of each track in the large arrays, which are not copied at every frame
        self._patches = np.zeros((0, side, side), np.uint8)
        self._warped = np.zeros((0, tile, tile), np.uint8)
        self._affine = np.zeros((0, 2, 2), np.float32)  # birth patch -> current frame
        self._warped_by = np.zeros((0, 2, 2), np.float32)
        self._warping: list[Future[None]] = []

    def add(self, grey: Image, xy: Array) -> None:
        """Store the patches around points of the current frame."""
        patches = _cut(grey, xy, _SUPPORT)
        unit = np.tile(np.eye(2, dtype=np.float32), (len(xy), 1, 1))
        inner = slice(_SUPPORT - self._half, _SUPPORT + self._half + 1)
        self._join({"_patches": patches, "_warped": patches[:, inner, inner], "_affine": unit, "_warped_by": unit})

    def take(self, rows: NDArray[np.bool_] | Rows) -> BirthPatches:
        """Patches of their own for some of the tracks."""
        taken = BirthPatches(self._window[0])
        taken._join(self._of(rows))
        return taken

    def append(self, other: BirthPatches) -> None:
        """Add the tracks of others."""
        self._join(other.state())

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything that `restore` needs."""
        return self._of(slice(None))

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `state` was taken."""
        self.keep(slice(0))
        self._join(state)

    def keep(self, index: NDArray[np.bool_] | Rows | slice) -> None:
        """Forget all others."""
        self._wait()
        for name in ("_slots", *_SMALL):
            setattr(self, name, getattr(self, name)[index])

    def _of(self, index: NDArray[np.bool_] | Rows | slice) -> dict[str, NDArray[Any]]:
        self._wait()
        large = {name: getattr(self, name)[self._slots[index]] for name in _LARGE}
        return {**large, **{name: getattr(self, name)[index] for name in _SMALL}}

    def _join(self, tracks: Mapping[str, NDArray[Any]]) -> None:
        """Add tracks, in slots that nobody uses any more where there are enough."""
        self._wait()
        count = len(tracks["_affine"])
        missing = count - (len(self._patches) - len(self._slots))
        if missing > 0:
            more = max(missing, len(self._patches) // 2)
            for name in _LARGE:
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), np.uint8)]))
        free = np.ones(len(self._patches), bool)
        free[self._slots] = False
        slots = np.flatnonzero(free)[:count]
        for name in _LARGE:
            getattr(self, name)[slots] = tracks[name]
        self._slots = np.r_[self._slots, slots]
        for name in _SMALL:
            setattr(self, name, np.concatenate([getattr(self, name), tracks[name]]))

    def move(self, linear: Array) -> None:
        """Follow the (n, 2, 2) linear parts of the local motion between two frames."""
        self._affine = linear @ self._affine

    def warp_ahead(self, pool: ThreadPoolExecutor) -> None:
        """Prepare the alignment with the next frame, of which only the position is missing, while nobody waits."""
        self._wait()
        self._warping = [pool.submit(self._warp, rows) for rows in np.array_split(np.arange(len(self._affine)), 2)]

    def _wait(self) -> None:
        """Nothing may be changed while patches are warped."""
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
        """Align the patches of `rows` with a frame, from `start`; positions, and which of them can be trusted.

        Args:
            check_px: largest error of the way back; those that are not `checked` (default: all are) must find it only
                where too many others do not.
            reach_px: largest distance from `start`.
        """
        self._wait()
        self._warp(rows)
        checked = np.ones(len(rows), bool) if checked is None else checked

        tile = 2 * self._half + 1
        columns = grey.shape[1] // tile
        order = np.argsort(start[:, 1], kind="stable")
        margin = self._half + int(np.ceil(reach_px)) + _MARGIN

        def part(index: Rows) -> tuple[Array, NDArray[np.bool_]]:
            """In a band of the image: preparing all of it for each part takes longer than following many points."""
            mine = order[index]
            height = max(-(-len(mine) // columns) * tile, int(np.ptp(start[mine, 1])) + 2 * margin)
            top = int(np.clip(start[mine[0], 1] - margin, 0, max(0, grey.shape[0] - height)))
            shift = np.array([0, top], np.float32)
            band = grey[top : top + height]
            found, good = self._align(band, rows[mine], start[mine] - shift, check_px, reach_px, checked[mine])
            return found + shift, good

        found, good = in_parts(part, len(rows), columns * (grey.shape[0] // tile), pool)
        back = np.argsort(order)
        return found[back], good[back]

    def _align(
        self, grey: Image, rows: Rows, start: Array, check_px: float, reach_px: float, checked: NDArray[np.bool_]
    ) -> tuple[Array, NDArray[np.bool_]]:
        tiles = self._warped[self._slots[rows]]
        if _exposure_changed(tiles, grey, start):  # only then: the fit would cost a little accuracy
            tiles = _lit_as(tiles, grey, start)
        atlas, centers = _atlas(tiles, grey.shape)
        aligned, status, _ = cv2.calcOpticalFlowPyrLK(
            atlas, grey, centers, start.copy(), winSize=self._window, maxLevel=0, criteria=_FINE,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        good = (status[:, 0] == 1) & (np.linalg.norm(aligned - start, axis=1) < reach_px)

        def stays(index: Rows) -> NDArray[np.bool_]:
            """Whether the way back ends where it began."""
            back, status, _ = cv2.calcOpticalFlowPyrLK(
                grey, atlas, aligned[index], centers[index], winSize=self._window, maxLevel=0, criteria=_BACK,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            return np.asarray((status[:, 0] == 1) & (np.linalg.norm(back - centers[index], axis=1) < check_px))

        some, rest = np.nonzero(good & checked)[0], np.nonzero(good & ~checked)[0]
        if len(some):
            good[some] = stays(some)
        if len(rest) and (not len(some) or good[some].mean() < _ALL_GOOD):
            good[rest] = stays(rest)
        return aligned, good

    def _warp(self, rows: Rows) -> None:
        """Warp the patches whose map has changed."""
        change = np.abs(self._affine[rows] - self._warped_by[rows]).sum(axis=2).max(axis=1) * self._half
        stale = rows[change > _STALE_PX]
        if not len(stale):
            return
        slots = self._slots[stale]
        self._warped[slots] = _warped(self._patches[slots], self._affine[stale], self._half)
        self._warped_by[stale] = self._affine[stale]


def in_parts(
    function: Callable[[Rows], tuple[Array, NDArray[np.bool_]]], count: int, room: int, pool: ThreadPoolExecutor
) -> tuple[Array, NDArray[np.bool_]]:
    """`function` of the rows 0..count in parts of at most `room`, joined; two parts at least, for two cores."""
    parts = np.array_split(np.arange(count), max(2 if count > _WORTH_TWO else 1, -(-count // room)))
    values, flags = zip(*pool.map(function, parts), strict=True)
    return np.concatenate(values), np.concatenate(flags)


def _cut(grey: Image, xy: Array, half: int) -> Image:
    """(n, 2 half + 1, 2 half + 1) patches around points at the nearest pixel; borders as in OpenCV's flow."""
    side = 2 * half + 1
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REFLECT_101)
    x, y = np.clip(np.rint(xy), 0, np.array(grey.shape[::-1]) - 1).astype(int).T
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, (side, side))[y, x], np.uint8)


def _exposure_changed(tiles: Image, grey: Image, xy: Array) -> bool:
    """Whether the image at these places is lighter or darker than the (n, side, side) tiles, as a few of them tell."""
    half = tiles.shape[1] // 2
    x, y = np.rint(xy).astype(int).T
    h, w = grey.shape
    inside = np.nonzero((x >= half) & (y >= half) & (x < w - half) & (y < h - half))[0]
    if not len(inside):
        return False
    few = inside[:: -(-len(inside) // _WITNESSES)]
    windows = np.lib.stride_tricks.sliding_window_view(grey, tiles.shape[1:])[y[few] - half, x[few] - half]
    seen, known = (
        cv2.reduce(a.reshape(len(few), -1), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F) for a in (windows, tiles[few])
    )
    return bool(abs(np.median(seen - known)) >= _EXPOSURE_CHANGE)


def _lit_as(tiles: Image, grey: Image, xy: Array) -> Image:
    """Tiles (n, side, side) with the mean and the contrast of the image at these places."""
    n, side, _ = tiles.shape
    tile, seen = (a.reshape(n, -1).astype(np.float32) for a in (tiles, _cut(grey, xy, side // 2)))
    mean, seen_mean = (a.mean(axis=1, keepdims=True) for a in (tile, seen))
    tile -= mean
    seen -= seen_mean
    contrast, seen_contrast = (np.sqrt(np.einsum("ij,ij->i", a, a))[:, None] for a in (tile, seen))
    gain = np.clip(seen_contrast / np.maximum(contrast, 1.0), 1.0 / _MOST_GAIN, _MOST_GAIN)
    tile *= gain
    tile += seen_mean
    return np.clip(np.rint(tile, out=tile), 0, 255).astype(np.uint8).reshape(tiles.shape)


def _warped(patches: Image, affine: Array, half: int) -> Image:
    """(n, side, side) patches warped by (n, 2, 2) affine maps about their centres, (n, 2 half + 1, 2 half + 1)."""
    n, side, _ = patches.shape
    tile = 2 * half + 1
    offset = np.arange(-half, half + 1, dtype=np.float32)
    grid = np.stack([np.tile(offset, tile), np.repeat(offset, tile), np.full(tile * tile, _SUPPORT, np.float32)])
    back = np.concatenate([np.linalg.inv(affine), np.ones((n, 2, 1), np.float32)], 2)
    # One product for all patches: a small one for each would cost as much as the interpolation.
    maps = (back.transpose(1, 0, 2).reshape(2 * n, 3) @ grid).reshape(2, n, tile * tile)
    np.clip(maps, 0, side - 1, out=maps)
    per_call = 30000 // side  # remap reads images of fewer than 32,768 rows
    maps[1] += (np.arange(n, dtype=np.float32) % per_call * side)[:, None]
    out = np.empty((n, tile, tile), np.uint8)
    for i in range(0, n, per_call):
        part = slice(i, i + per_call)
        out[part] = cv2.remap(
            patches[part].reshape(-1, side), maps[0, part], maps[1, part], cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, tile, tile)  # fmt: skip
    return out


def _atlas(tiles: Image, shape: tuple[int, ...]) -> tuple[Image, Array]:
    """Square tiles laid out in one image of the frame's size, and their centres."""
    n, side, _ = tiles.shape
    columns = shape[1] // side
    atlas = np.zeros(shape, np.uint8)
    place = atlas[: shape[0] // side * side, : columns * side].reshape(-1, side, columns, side)
    full, rest = divmod(n, columns)
    place[:full] = tiles[: full * columns].reshape(full, columns, side, side).transpose(0, 2, 1, 3)
    if rest:
        place[full, :, :rest] = tiles[full * columns :].transpose(1, 0, 2)
    r, c = np.divmod(np.arange(n), columns)
    return atlas, np.stack([c * side + side // 2, r * side + side // 2], -1).astype(np.float32)
