"""Working copies of the photographs of a set: the same pixels are one photograph, other pixels never are."""

import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm import Frame
from factorsfm.imagesets.photo_folder import PhotoFolder, pixel_digest

Image = NDArray[np.uint8]


def image(seed: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def same_crc32(pixels: Image, like: Image) -> Image:
    """The image with other last four bytes, such that both have one CRC-32: it is linear in the bits."""
    start = pixels.tobytes()[:-4]

    def difference(tail: int) -> int:
        return zlib.crc32(start + tail.to_bytes(4, "little")) ^ zlib.crc32(like.tobytes())

    rows = [(difference(1 << bit) ^ difference(0), 1 << bit) for bit in range(32)]
    wanted, tail = difference(0), 0
    for bit in reversed(range(32)):
        pivot = next(k for k, (value, _) in enumerate(rows) if value >> bit == 1)
        value, bits = rows.pop(pivot)
        rows = [(v ^ value, b ^ bits) if v >> bit & 1 else (v, b) for v, b in rows]
        if wanted >> bit & 1:
            wanted, tail = wanted ^ value, tail ^ bits
    forged = np.frombuffer(start + tail.to_bytes(4, "little"), np.uint8).reshape(pixels.shape)
    assert zlib.crc32(forged.tobytes()) == zlib.crc32(like.tobytes())
    return forged


def test_only_the_same_pixels_are_twins(tmp_path: Path) -> None:
    photos, first = PhotoFolder(tmp_path, masked=False), image(1)
    other = same_crc32(image(2), first)
    kept = [photos.keep(Frame(k, i, f"{k}.png"), i, None, k) for k, i in enumerate([first, other, first.copy()])]
    assert [photo.twin for photo in kept] == [None, None, 0]
    for photo, pixels in zip(kept, (first, other), strict=False):
        np.testing.assert_array_equal(photos.read(photo), pixels)
    assert sorted(path.name for path in photos.images.iterdir()) == [photo.file for photo in kept[:2]]


def test_the_digest_tells_masks_sizes_and_pixels_apart() -> None:
    pixels, mask = image(1), np.zeros((24, 32), bool)
    wide = pixels.reshape(12, 64, 3)
    digests = [pixel_digest(pixels), pixel_digest(pixels, mask), pixel_digest(pixels, ~mask), pixel_digest(wide)]
    assert len({*digests, pixel_digest(image(2))}) == 5
    assert pixel_digest(pixels) == pixel_digest(np.asfortranarray(pixels)) == pixel_digest(np.flip(np.flip(pixels)))
    assert all(len(digest) == 32 for digest in digests)
