"""The photographs of an image set and their working copies."""

from __future__ import annotations

import hashlib
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.frames.photographs import turned_left
from factorsfm.frames.writing import FAST_PNG, write_image
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

MAX_SIDE = 3200  # pixels; larger images are matched and reconstructed at this size


@dataclass(slots=True)
class Photo:
    """A photograph of a set, without its pixels.

    Attributes:
        index, name, timestamp: see `Frame`.
        file: name of the copy in the work folder, empty if the photograph is left out; size: (width, height) of the
            copy.
        full_size: (width, height) of the photograph.
        left_out: why the photograph is not used, empty if it is; twin: position of an earlier one with the same pixels.
        remark: note for the user.
        focal_ratio: focal length divided by the longer side, from EXIF; 0 if unknown.
        camera: position in the list of the set's cameras.
    """

    index: int
    name: str
    timestamp: float | None
    file: str = ""
    size: tuple[int, int] = (0, 0)
    full_size: tuple[int, int] = (0, 0)
    left_out: str = ""
    twin: int | None = None
    remark: str = ""
    focal_ratio: float = 0.0
    camera: int = 0


class PhotoFolder:
    """Working copies of the images and masks of a set; images with the same pixels share one.

    Args:
        folder: of the copies; copies of an earlier run are used again.
        masked: whether the images have masks.
    """

    def __init__(self, folder: Path, *, masked: bool) -> None:
        self.images = folder / "images"
        self.masks = folder / "masks" if masked else None
        self._known: dict[str, int] = {}
        self.images.mkdir(parents=True, exist_ok=True)

    def keep(self, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, position: int) -> Photo:
        """Copy an image, (h, w, 3) BGR, and its mask.

        Args:
            position: of the photograph in the set.

        Raises:
            InputError: the folder cannot be written.
        """
        height, width = image.shape[:2]
        photo = Photo(frame.index, frame.name, frame.timestamp, full_size=(width, height))
        image, mask = _bounded(image, mask)
        photo.size = image.shape[1], image.shape[0]
        if max(width, height) > MAX_SIDE:
            photo.remark = f"reduced from {size_text(photo.full_size)} to {size_text(photo.size)} pixels"
            logger.warning("%s is %s", frame.name, photo.remark)
        key = pixel_digest(image, mask)
        photo.file = f"{frame.index:06d}-{key}.png"
        first = self._known.setdefault(key, position)
        if first != position:
            photo.twin = first
            return photo
        write_once(self.images / photo.file, image)
        if self.masks is not None:
            ignored = np.zeros(image.shape[:2], bool) if mask is None else mask
            write_once(self.masks / f"{photo.file}.png", np.where(ignored, 0, 255).astype(np.uint8))
        return photo

    def read(self, photo: Photo) -> NDArray[np.uint8]:
        """The working copy, (h, w, 3) BGR."""
        return np.asarray(cv2.imread(str(self.images / photo.file)), np.uint8)

    def turn(self, photo: Photo) -> None:
        """Turn the working copy by 90 degrees."""
        turned = photo.file.replace(".png", "-turned.png")
        write_once(self.images / turned, turned_left(self.read(photo)))
        if self.masks is not None:
            sideways = cv2.imread(str(self.masks / f"{photo.file}.png"), cv2.IMREAD_GRAYSCALE)
            write_once(self.masks / f"{turned}.png", turned_left(np.asarray(sideways, np.uint8)))
        photo.remark = "turned left by 90 degrees to the format of the others; its pose is that of the turned image"
        logger.warning("%s is %s", photo.name, photo.remark)
        photo.file, photo.size, photo.full_size = turned, photo.size[::-1], photo.full_size[::-1]


def pixel_digest(image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> str:
    """Identifies an image with its mask: a hexadecimal digest of 128 bits, so different images never share one."""
    digest = hashlib.blake2b(f"{image.shape}".encode(), digest_size=16)
    for pixels in (image, mask) if mask is not None else (image,):
        digest.update(np.ascontiguousarray(pixels).data)
    return digest.hexdigest()


def size_text(size: tuple[int, int]) -> str:
    """(width, height) as text."""
    return f"{size[0]}x{size[1]}"


def _bounded(
    image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    height, width = image.shape[:2]
    factor = MAX_SIDE / max(width, height)
    if factor >= 1.0:
        return image, mask
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    reduced = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if mask is None:
        return reduced, None
    return reduced, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def write_once(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image into a work folder, unless the file exists; an existing file is always complete.

    Raises:
        InputError: the file cannot be written.
    """
    if path.exists():
        return
    unfinished = path.with_suffix(".unfinished.png")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(unfinished, image, FAST_PNG)
        unfinished.replace(path)
    except OSError as error:
        raise InputError(f"cannot write to the work folder {path.parent}: {error.strerror or error}") from error


@contextmanager
def work_folder(work: str | Path | None) -> Iterator[Path]:
    """Yields the folder, or a temporary one for None.

    Raises:
        InputError: the folder cannot be made.
    """
    if work is not None:
        try:
            Path(work).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"the work folder {work} cannot be made: {error.strerror}") from error
        yield Path(work)
        return
    with tempfile.TemporaryDirectory(prefix="factorsfm-") as folder:
        yield Path(folder)
