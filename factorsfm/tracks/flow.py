"""Tracks from video: pyramidal Lucas-Kanade, re-aligned against the patch of each track's first appearance.

Chained optical flow drifts, and in a shot with little parallax the drift is as large as the signal. So every track
keeps the patch around its first appearance and the affine map that carries this patch into the current frame
(followed from frame to frame with the local motion of its neighbours). After each flow step the patch is warped with
that map and aligned with the current frame once more, which cancels the drift without any model of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.options import TrackerOptions

Array = NDArray[np.float32]
Image = NDArray[np.uint8]

_PATCH_SUPPORT = 22  # half side of a stored birth patch: the window at half the birth's scale, with its margin
_GRID = 24  # cells along the longer image side in which the local motion is estimated
_BLANK_SHARE = 0.2  # of the texture of the last frame; with less, a frame among others is black or a flash


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Tracks alive in one frame.

    Attributes:
        ids: (n,) identities, never reused; none in a frame that is blank beside the one before.
        xy: (n, 2) pixels, centres at integers.
        lost: tracks that ended here.
        born: tracks that start here.
        flow: median displacement against the frame before (pixels); NaN in the first frame.
        texture: standard deviation of the Laplacian at the scale of a feature (grey levels), a measure of blankness.
    """

    ids: NDArray[np.int64]
    xy: NDArray[np.float64]
    lost: int
    born: int
    flow: float
    texture: float


class FlowTracker:
    """Follows image points through a video, one frame at a time, in bounded memory."""

    def __init__(self, options: TrackerOptions) -> None:
        self.options = options
        self._previous: Image | None = None
        self._texture = 0.0  # of the previous image
        self._frame = 0
        self._next_id = 0
        self._ids = np.zeros(0, np.int64)
        self._xy = np.zeros((0, 2), np.float32)
        self._born_at = np.zeros(0, np.int64)
        side = self._tile = 2 * _PATCH_SUPPORT + 1
        self._patches = np.zeros((0, side, side), np.uint8)
        self._affine = np.zeros((0, 2, 2), np.float32)  # birth patch -> current frame

    def track(self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> TrackedFrame:
        """Follow all tracks into `image` and start new ones where the image is not covered.

        Args:
            image: (h, w, 3) BGR or (h, w) grey.
            mask: (h, w), True where nothing may be tracked.
        """
        grey = np.ascontiguousarray(image) if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        texture = _texture(grey)
        if texture < _BLANK_SHARE * self._texture:  # the tracks wait for the next frame that shows something
            return TrackedFrame(np.zeros(0, np.int64), np.zeros((0, 2)), 0, 0, float("nan"), texture)
        before = len(self._ids)
        flow = float("nan")
        if self._previous is not None and before:
            start = self._xy
            kept = self._step(self._previous, grey, mask)
            if len(self._ids):
                flow = float(np.median(np.linalg.norm(self._xy - start[kept], axis=1)))
        lost = before - len(self._ids)
        born = self._replenish(grey, mask)
        self._previous, self._texture = grey, texture
        self._frame += 1
        return TrackedFrame(self._ids.copy(), self._xy.astype(np.float64), lost, born, flow, texture)

    def drop(self, ids: NDArray[np.int64]) -> None:
        """End tracks that the mapper found to be outliers."""
        self._keep(~np.isin(self._ids, ids))

    def _keep(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> None:
        self._ids = self._ids[index]
        self._xy = self._xy[index]
        self._born_at = self._born_at[index]
        self._patches = self._patches[index]
        self._affine = self._affine[index]

    def _step(self, previous: Image, grey: Image, mask: NDArray[np.bool_] | None) -> NDArray[np.intp]:
        """Flow from the frame before, then re-alignment with the birth patches; returns the kept rows."""
        o = self.options
        old = self._xy
        new, ok = _flow_checked(previous, grey, old, o.window_px, o.levels, o.flow_check_px)
        ok &= _inside(new, grey.shape, o.border_px)
        if mask is not None:
            ok &= ~_at(mask, new)
        kept = np.nonzero(ok)[0]
        self._xy = new
        self._keep(kept)
        if len(kept) == 0:
            return kept
        self._affine = _local_affine(old[kept], self._xy, grey.shape) @ self._affine
        aligned, good = self._realign(grey)
        if mask is not None:
            good &= ~_at(mask, aligned)
        good &= _inside(aligned, grey.shape, o.border_px)
        self._xy = aligned
        self._keep(good)
        return kept[good]

    def _realign(self, grey: NDArray[np.uint8]) -> tuple[Array, NDArray[np.bool_]]:
        """Align every birth patch, warped into the current frame, with the current frame."""
        o = self.options
        n = len(self._ids)
        young = self._born_at >= self._frame - 1
        half = o.window_px // 2 + 2
        atlas, centers = _warped_atlas(self._patches, self._affine, half, grey.shape)
        height = max(atlas.shape[0], grey.shape[0])
        atlas = cv2.copyMakeBorder(atlas, 0, height - atlas.shape[0], 0, 0, cv2.BORDER_REPLICATE)
        padded = cv2.copyMakeBorder(grey, 0, height - grey.shape[0], 0, 0, cv2.BORDER_REFLECT_101)
        aligned, status, _ = cv2.calcOpticalFlowPyrLK(
            atlas,
            padded,
            centers,
            self._xy.copy(),
            winSize=(o.window_px, o.window_px),
            maxLevel=0,
            criteria=_FINE,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        back, status_back, _ = cv2.calcOpticalFlowPyrLK(
            padded,
            atlas,
            aligned,
            centers.copy(),
            winSize=(o.window_px, o.window_px),
            maxLevel=0,
            criteria=_FINE,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        good = (status[:, 0] == 1) & (status_back[:, 0] == 1)
        good &= np.linalg.norm(back - centers, axis=1) < o.realign_check_px
        good &= np.linalg.norm(aligned - self._xy, axis=1) < o.realign_reach_px
        aligned = np.where(young[:, None], self._xy, aligned)
        return aligned.reshape(n, 2), good | young

    def _replenish(self, grey: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> int:
        """Start tracks where the image is not covered, strongest corners first in every cell."""
        o = self.options
        room = o.max_tracks - len(self._ids)
        if room < o.max_tracks * o.replenish_below:
            return 0
        h, w = grey.shape
        free = np.zeros((h, w), np.uint8)
        free[o.border_px : h - o.border_px, o.border_px : w - o.border_px] = 255
        if mask is not None:
            free[mask] = 0
        radius = max(4, round(0.4 * (w * h / o.max_tracks) ** 0.5))
        for x, y in self._xy.round().astype(int):
            cv2.circle(free, (int(x), int(y)), radius, 0, -1)
        corners = cv2.goodFeaturesToTrack(grey, 0, o.corner_quality, radius, mask=free, blockSize=5)
        if corners is None:
            return 0
        corners = _spread(corners[:, 0], room, grey.shape)
        m = len(corners)
        self._ids = np.r_[self._ids, np.arange(self._next_id, self._next_id + m)]
        self._next_id += m
        self._xy = np.r_[self._xy, corners].astype(np.float32)
        self._born_at = np.r_[self._born_at, np.full(m, self._frame)]
        self._patches = np.r_[self._patches, _cut_patches(grey, corners, _PATCH_SUPPORT)]
        self._affine = np.r_[self._affine, np.tile(np.eye(2, dtype=np.float32), (m, 1, 1))]
        return m


_STOP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
_COARSE = (_STOP, 12, 0.02)  # from frame to frame: the re-alignment does the rest
_FINE = (_STOP, 30, 0.003)


def _texture(grey: Image) -> float:
    # In floats: the rounding of 8 bits alone would look like texture.
    return float(cv2.Laplacian(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5), cv2.CV_32F).std())


def _flow_checked(
    a: Image, b: Image, xy: Array, window: int, levels: int, limit: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Flow a -> b of points, and whether the way back, tried from where it should end, stays there."""
    side = (window, window)
    forward, status, _ = cv2.calcOpticalFlowPyrLK(a, b, xy, None, winSize=side, maxLevel=levels, criteria=_COARSE)
    back, status_back, _ = cv2.calcOpticalFlowPyrLK(
        b, a, forward, xy.copy(), winSize=side, maxLevel=1, criteria=_COARSE,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    ok = (status[:, 0] == 1) & (status_back[:, 0] == 1)
    ok &= np.linalg.norm(back - xy, axis=1) < limit
    return forward, ok


def _inside(xy: Array, shape: tuple[int, ...], border: int) -> NDArray[np.bool_]:
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


def _cut_patches(grey: NDArray[np.uint8], xy: Array, support: int) -> NDArray[np.uint8]:
    """(n, side, side) patches resampled so that each point lies exactly in the centre; borders as in OpenCV's flow."""
    offset = np.arange(-support, support + 1, dtype=np.float32)
    side = len(offset)
    map_x = np.broadcast_to(xy[:, 0, None, None] + offset, (len(xy), side, side)).reshape(-1, side)
    map_y = np.broadcast_to(xy[:, 1, None, None] + offset[:, None], (len(xy), side, side)).reshape(-1, side)
    return _remap(grey, map_x, map_y).reshape(-1, side, side)


def _remap(image: NDArray[np.uint8], map_x: Array, map_y: Array) -> NDArray[np.uint8]:
    """`cv2.remap` with maps of any number of rows (one call takes fewer than 32,768)."""
    rows = [
        cv2.remap(image, np.ascontiguousarray(map_x[i : i + 30000]), np.ascontiguousarray(map_y[i : i + 30000]),
                  cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        for i in range(0, len(map_x), 30000)
    ]  # fmt: skip
    return np.concatenate(rows)


def _local_affine(old: Array, new: Array, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(n, 2, 2) linear part of the local motion old -> new: weighted regression on a grid of moments."""
    h, w = shape[:2]
    cell = max(h, w) / _GRID
    gw, gh = int(np.ceil(w / cell)), int(np.ceil(h / cell))
    p = old.astype(np.float64)
    u = (new - old).astype(np.float64)
    ij = np.minimum((p / cell).astype(int), [gw - 1, gh - 1])
    index = ij[:, 1] * gw + ij[:, 0]
    x, y = (p / cell).T
    columns = [np.ones_like(x), x, y, x * x, x * y, y * y]
    columns += [u[:, 0], u[:, 0] * x, u[:, 0] * y, u[:, 1], u[:, 1] * x, u[:, 1] * y]
    grid = np.stack([np.bincount(index, c, gw * gh) for c in columns], -1).reshape(gh, gw, -1)
    grid = cv2.GaussianBlur(grid, (0, 0), 1.5, borderType=cv2.BORDER_CONSTANT).reshape(gh * gw, -1)
    s1, sx, sy, sxx, sxy, syy, u0, u0x, u0y, v0, v0x, v0y = grid.T
    s1 = np.maximum(s1, 1e-12)
    mx, my = sx / s1, sy / s1
    cxx, cxy, cyy = sxx / s1 - mx * mx, sxy / s1 - mx * my, syy / s1 - my * my
    ridge = 0.3 / s1  # a cell with few tracks falls back to pure translation
    cxx, cyy = cxx + ridge, cyy + ridge
    det = cxx * cyy - cxy * cxy
    linear = np.empty((gh * gw, 2, 2))
    for row, (m0, m0x, m0y) in enumerate(((u0, u0x, u0y), (v0, v0x, v0y))):
        bx, by = m0x / s1 - m0 / s1 * mx, m0y / s1 - m0 / s1 * my
        linear[:, row, 0] = (cyy * bx - cxy * by) / det / cell
        linear[:, row, 1] = (cxx * by - cxy * bx) / det / cell
    return np.asarray(np.eye(2) + linear[index], np.float32)


def _warped_atlas(
    patches: NDArray[np.uint8], affine: NDArray[np.float32], half: int, shape: tuple[int, ...]
) -> tuple[NDArray[np.uint8], Array]:
    """All patches warped by their affine maps, laid out in one image as wide as the frame, and their centres."""
    n, side, _ = patches.shape
    tile = 2 * half + 1
    offset = np.arange(-half, half + 1, dtype=np.float32)
    inverse = np.linalg.inv(affine)
    dx = inverse[:, 0, 0, None, None] * offset + inverse[:, 0, 1, None, None] * offset[:, None]
    dy = inverse[:, 1, 0, None, None] * offset + inverse[:, 1, 1, None, None] * offset[:, None]
    support = (side - 1) / 2
    map_x = np.clip(dx + support, 0, side - 1)
    map_y = np.clip(dy + support, 0, side - 1) + (np.arange(n) * side)[:, None, None].astype(np.float32)
    per_call = 30000 // side  # remap reads images of fewer than 32,768 rows
    tiles = np.concatenate([
        cv2.remap(patches[i : i + per_call].reshape(-1, side), map_x[i : i + per_call].reshape(-1, tile),
                  (map_y[i : i + per_call] - np.float32(i * side)).reshape(-1, tile), cv2.INTER_CUBIC,
                  borderMode=cv2.BORDER_REPLICATE)
        for i in range(0, n, per_call)
    ])  # fmt: skip
    columns = shape[1] // tile
    rows = -(-n // columns)
    atlas = np.zeros((rows * columns, tile, tile), np.uint8)
    atlas[:n] = tiles.reshape(n, tile, tile)
    atlas = atlas.reshape(rows, columns, tile, tile).transpose(0, 2, 1, 3).reshape(rows * tile, columns * tile)
    atlas = cv2.copyMakeBorder(atlas, 0, 0, 0, shape[1] - columns * tile, cv2.BORDER_REPLICATE)
    r, c = np.divmod(np.arange(n), columns)
    centers = np.stack([c * tile + half, r * tile + half], -1).astype(np.float32)
    return atlas, centers
