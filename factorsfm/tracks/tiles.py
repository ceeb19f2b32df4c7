"""Small square images around n points: cut from a frame, matched in exposure, warped, laid out in one image."""

from __future__ import annotations

import math

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
    side, last = 2 * half + 1, np.array(grey.shape[::-1]) - 1
    pixel = nearest_pixels(xy, grey.shape)
    corner = np.clip(pixel - half, 0, np.maximum(last + 1 - side, 0))
    if side <= min(grey.shape):
        tiles = np.lib.stride_tricks.sliding_window_view(grey, (side, side))[corner[:, 1], corner[:, 0]]
        beyond = np.nonzero((corner != pixel - half).any(axis=1))[0]
    else:
        tiles, beyond = np.empty((len(xy), side, side), np.uint8), np.arange(len(xy))
    around = np.abs(pixel[beyond, :, None] + np.arange(-half, half + 1))  # (k, 2, side)
    x, y = np.moveaxis(last[:, None] - np.abs(last[:, None] - around), 1, 0)  # reflected as in OpenCV's flow
    tiles[beyond] = grey[y[:, :, None], x[:, None, :]]
    return tiles


def nearest_pixels(xy: Array, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """(n, 2) the pixel of an image that is nearest to each of n points."""
    return np.clip(np.rint(xy), 0, np.array(shape[1::-1]) - 1).astype(np.int64)


def inner_tiles(tiles: Image, half: int) -> Image:
    """The middle of tiles, (n, 2 half + 1, 2 half + 1)."""
    middle = tiles.shape[1] // 2
    return tiles[:, middle - half : middle + half + 1, middle - half : middle + half + 1]


def has_exposure_changed(tiles: Image, seen: Image) -> bool:
    """Whether what is seen now, (n, side, side), is lighter or darker than tiles of that shape, by a sample of them."""
    sampled = slice(None, None, -(-len(tiles) // _SAMPLED_TILES))
    now, then = (a[sampled].mean(axis=(1, 2), dtype=np.float32) for a in (seen, tiles))
    return bool(abs(np.median(now - then)) >= _EXPOSURE_CHANGE)


def match_tile_exposure(tiles: Image, seen_tiles: Image) -> Image:
    """Tiles (n, side, side) with the mean and the contrast of what is seen now, tile by tile."""
    n = len(tiles)
    tile, seen = (a.reshape(n, -1).astype(np.float32) for a in (tiles, seen_tiles))
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


def tile_atlas(tiles: Image, cell: int) -> tuple[Image, Array]:
    """Tiles (n, side, side) in the middle of square cells of one image, and the pixels of their centres, (n, 2)."""
    n, side, _ = tiles.shape
    columns = math.isqrt(n - 1) + 1
    margin = (cell - side) // 2
    atlas = np.zeros((-(-n // columns), cell, columns, cell), np.uint8)
    place = atlas[:, margin : margin + side, :, margin : margin + side]
    full, rest = divmod(n, columns)
    place[:full] = tiles[: full * columns].reshape(full, columns, side, side).transpose(0, 2, 1, 3)
    if rest:
        place[full, :, :rest] = tiles[full * columns :].transpose(1, 0, 2)
    r, c = np.divmod(np.arange(n), columns)
    return atlas.reshape(-1, columns * cell), (np.stack([c, r], -1) * cell + cell // 2).astype(np.float32)
