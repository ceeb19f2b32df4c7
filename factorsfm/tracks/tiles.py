"""Small square images around n points: cut from a frame, matched in exposure, warped, laid out in one image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Image = NDArray[np.uint8]

_EXPOSURE_CHANGE = 4.0  # grey levels of the median tile; without one it is up to 1.2, in fast motion more
_SAMPLED_TILES = 64  # that are compared to detect it
_MOST_GAIN = 4.0  # of the contrast of a tile
_REMAP_ROWS = 30_000  # per call: OpenCV's remap takes images of fewer than 32,768 rows


def cut_tiles(grey: Image, xy: Array, half: int) -> Image:
    """Tiles (n, 2 half + 1, 2 half + 1) around points (n, 2), at the nearest pixel; borders are reflected."""
    side = 2 * half + 1
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REFLECT_101)  # as in OpenCV's flow
    x, y = np.clip(np.rint(xy), 0, np.array(grey.shape[::-1]) - 1).astype(int).T
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, (side, side))[y, x], np.uint8)


def has_exposure_changed(tiles: Image, grey: Image, xy: Array) -> bool:
    """Whether an image at points (n, 2) is lighter or darker than tiles (n, side, side), by a sample of them."""
    half = tiles.shape[1] // 2
    x, y = np.rint(xy).astype(int).T
    h, w = grey.shape
    inside = np.nonzero((x >= half) & (y >= half) & (x < w - half) & (y < h - half))[0]
    if not len(inside):
        return False
    sampled = inside[:: -(-len(inside) // _SAMPLED_TILES)]
    windows = np.lib.stride_tricks.sliding_window_view(grey, tiles.shape[1:])[y[sampled] - half, x[sampled] - half]
    in_image, in_tile = (
        cv2.reduce(a.reshape(len(sampled), -1), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F) for a in (windows, tiles[sampled])
    )
    return bool(abs(np.median(in_image - in_tile)) >= _EXPOSURE_CHANGE)


def match_tile_exposure(tiles: Image, grey: Image, xy: Array) -> Image:
    """Tiles (n, side, side) with the mean and the contrast of an image at points (n, 2)."""
    n, side, _ = tiles.shape
    tile, seen = (a.reshape(n, -1).astype(np.float32) for a in (tiles, cut_tiles(grey, xy, side // 2)))
    mean, seen_mean = (a.mean(axis=1, keepdims=True) for a in (tile, seen))
    tile -= mean
    seen -= seen_mean
    contrast, seen_contrast = (np.sqrt(np.einsum("ij,ij->i", a, a))[:, None] for a in (tile, seen))
    gain = np.clip(seen_contrast / np.maximum(contrast, 1.0), 1.0 / _MOST_GAIN, _MOST_GAIN)
    tile *= gain
    tile += seen_mean
    return np.clip(np.rint(tile, out=tile), 0, 255).astype(np.uint8).reshape(tiles.shape)


def warp_tiles(tiles: Image, affine: Array, half: int) -> Image:
    """Tiles (n, side, side) warped by affine maps (n, 2, 2) about their centres, (n, 2 half + 1, 2 half + 1)."""
    n, side, _ = tiles.shape
    center, out_side = side // 2, 2 * half + 1
    offset = np.arange(-half, half + 1, dtype=np.float32)
    across, down = np.tile(offset, out_side), np.repeat(offset, out_side)
    grid = np.stack([across, down, np.full(out_side * out_side, center, np.float32)])
    inverse = np.concatenate([np.linalg.inv(affine), np.ones((n, 2, 1), np.float32)], 2)
    # One product for all tiles: a small one for each would cost as much as the interpolation.
    maps = (inverse.transpose(1, 0, 2).reshape(2 * n, 3) @ grid).reshape(2, n, out_side * out_side)
    np.clip(maps, 0, side - 1, out=maps)
    per_call = _REMAP_ROWS // side
    maps[1] += (np.arange(n, dtype=np.float32) % per_call * side)[:, None]
    out = np.empty((n, out_side, out_side), np.uint8)
    for i in range(0, n, per_call):
        part = slice(i, i + per_call)
        out[part] = cv2.remap(
            tiles[part].reshape(-1, side), maps[0, part], maps[1, part], cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, out_side, out_side)  # fmt: skip
    return out


def tile_atlas(tiles: Image, shape: tuple[int, ...]) -> tuple[Image, Array]:
    """Tiles (n, side, side) side by side in one image (h, w), and the pixels of their centres, (n, 2)."""
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
