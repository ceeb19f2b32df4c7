"""A frame: an image and its number in the source."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.tone import eight_bits
from factorsfm.support.errors import InputError
from factorsfm.support.file_names import check_name
from factorsfm.support.picture_area import PictureArea


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a shot.

    Attributes:
        index: number of the frame: that in the file name for a folder with a numbered sequence (1043 of
            ``plate.1043.exr``), else its position in the source, from 0; no range or step changes it.
        image: (h, w, 3) uint8, BGR.
        name: file name, perhaps with folders before it, or the zero-padded index for videos and iterables.
        timestamp: seconds from the start of the video, or those in the file name (``1305031102.175304.png``); None if
            unknown.
        dropped: number of frames of a live source that were dropped right before this one.
        path: the image file, whose EXIF data may hold the focal length; None if the frame is not from an image file.
        pixel_aspect: width of a shown pixel over its height, 1 for square ones.
        is_field: whether it is one field of an interlaced frame, half of its lines.
        picture: what of the image is picture, where it has black bars beside it; None if all of it is, or unknown.

    Raises:
        InputError: the name is a path that leaves its folder.
    """

    index: int
    image: NDArray[np.uint8]
    name: str
    timestamp: float | None = None
    dropped: int = 0
    path: Path | None = None
    pixel_aspect: float = 1.0
    is_field: bool = False
    picture: PictureArea | None = None

    def __post_init__(self) -> None:
        check_name(self.name)


def bgr_image(image: object, index: int) -> NDArray[np.uint8]:
    """(h, w, 3) uint8 from a grey, BGR or BGRA image of 8 or 16 bits.

    Args:
        index: of the frame, for the error message.

    Raises:
        InputError: another type, shape or number of bits.
    """
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16):
        found = f"an array of {image.dtype}" if isinstance(image, np.ndarray) else f"of type {type(image).__name__}"
        raise InputError(f"frame {index} is {found}; an array of uint8 or uint16 is expected")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or channels not in (1, 3, 4) or image.size == 0:
        raise InputError(f"frame {index} has shape {image.shape}; (h, w), (h, w, 3) or (h, w, 4) is expected")
    depth8 = eight_bits(image)
    if channels == 1:
        return np.repeat(depth8.reshape(*depth8.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(depth8[:, :, :3])


def as_frame(frame: Frame | NDArray[np.uint8], index: int) -> Frame:
    """The frame, its image converted to 8-bit BGR; a bare image becomes frame number `index`.

    Raises:
        InputError: the image has another type, shape or number of bits, see `bgr_image`.
    """
    if not isinstance(frame, Frame):
        frame = Frame(index, frame, f"{index:06d}", None)
    return replace(frame, image=bgr_image(frame.image, frame.index))
