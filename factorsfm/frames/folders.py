"""Image files, and folders of them."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.image_damage import damage_of, without_padding
from factorsfm.frames.plates import PLATE_SUFFIXES, Pixels, plate_pixel_aspect, read_dpx, read_exr
from factorsfm.frames.silence import held_back, opencv_errors, quiet_opencv
from factorsfm.frames.tone import eight_bits
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import is_text

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}) | PLATE_SUFFIXES
# Of phones, cameras and film tools; FFmpeg would take the tiles of the first ones for videos.
UNREAD_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif", ".tga", ".psd", ".hdr", ".cin", ".ppm", ".pgm"}
    | {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
)
_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TIFF_DAMAGE = re.compile("TIFF_Error (ZIPDecode|PackBitsDecode|Using code not yet|.*(Not enough data|Corrupted))")


def list_images(folder: Path) -> list[Path]:
    """Images of a folder in natural order (img2 before img10); an empty list if there are none."""
    return list_files(folder, IMAGE_SUFFIXES)


def unread_images(folder: Path) -> list[str]:
    """Names of the images of a folder in formats that are not read, without those that are beside as another file."""
    read = {path.stem for path in list_images(folder)}
    return [path.name for path in list_files(folder, UNREAD_SUFFIXES) if path.stem not in read]


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these suffixes (lower case) in natural order, without hidden files.

    A symbolic link that leads nowhere counts, so that whoever reads it says so: its frame must not be missed silently.

    Raises:
        InputError: the name of one of them is not text.
    """
    named = (path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith("."))
    found = [path for path in named if path.is_file() or (path.is_symlink() and not path.exists())]
    for path in found:
        if not is_text(path.name):
            raise InputError(f"the file name {path.name!r} in {folder} is not UTF-8; rename the file")
    return sorted(found, key=natural_key)


def natural_key(path: Path) -> tuple[list[str | int], str]:
    """Sorts names as people do: img2 before img10."""
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(parts)], path.name


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image file as (h, w, 3) uint8 BGR, from more bits through `tone.eight_bits`.

    Raises:
        InputError: the file is missing, damaged, truncated or not an image.
    """
    return eight_bits(read_pixels(path))


def read_pixels(path: Path) -> Pixels:
    """An image file as (h, w, 3) BGR with all of its bits: uint8, uint16, or half or float for linear light.

    Raises:
        InputError: the file is missing, damaged, truncated or not an image.
    """
    try:
        if path.suffix.lower() == ".exr":
            path.stat()  # says why a file cannot be read
            return read_exr(path)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror}") from error
    if path.suffix.lower() == ".dpx":
        return read_dpx(data, path)
    # Checked before decoding: libjpeg would fill the rest with grey, libpng would write to stderr, past all logging.
    damage = damage_of(data)
    if damage in ("truncated", "damaged"):
        raise InputError(f"image {path} is {damage}")
    try:
        if damage == "doubtful" and all(map(_libjpeg_complains, (data, without_padding(data)))):
            raise InputError(f"image {path} is damaged")
        image = _decoded_tiff(data, path) if data.startswith(_TIFF_STARTS) else _decoded(data)
    except cv2.error as error:
        raise InputError(f"image {path} cannot be decoded; it has too many pixels or is damaged") from error
    if image is None:
        raise InputError(f"image {path} cannot be decoded; it is damaged, truncated or not an image")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"image {path} has pixels of {image.dtype}; 8 or 16 bits a channel, or float32, are expected")
    return np.asarray(image)


def _decoded(data: bytes) -> NDArray[np.generic] | None:
    with quiet_opencv():
        return cv2.imdecode(np.frombuffer(data, np.uint8), _COLOR) if data else None


def _decoded_tiff(data: bytes, path: Path) -> NDArray[np.generic] | None:
    """OpenCV leaves parts black that cannot be decoded, and says so in its log alone."""
    with opencv_errors() as said:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _COLOR)
    if _TIFF_DAMAGE.search(said.errors):
        raise InputError(f"image {path} is damaged or truncated")
    return image


def _libjpeg_complains(data: bytes) -> bool:
    with held_back() as said:
        _decoded(data)
    return "Corrupt JPEG data" in said.errors


def stated_pixel_aspect(path: Path) -> float:
    """Width of a pixel over its height as an image file says, 1 if it says nothing.

    Raises:
        InputError: a plate is damaged.
    """
    return plate_pixel_aspect(path) if path.suffix.lower() in PLATE_SUFFIXES else 1.0
