"""Frames of a shot, from a video file, a folder of images or an iterable of images."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.aspect import check_pixel_aspect
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import IMAGE_SUFFIXES, UNREAD_SUFFIXES, read_image, stated_pixel_aspect
from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.frames.numbering import FrameFile, chosen, numbered_images
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.video import decode, open_video
from factorsfm.support.errors import InputError

_PATTERN = re.compile(r"%0?\d*d|#|\*|\?|\[")  # of names, as other tools take it for the images of a folder


def read_frames(
    source: str | Path | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame],
    frames: slice | None = None,
    *,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
) -> Iterator[Frame]:
    """Read the frames of a shot one by one, in bounded memory.

    Grey, 16-bit, high dynamic range and alpha images become 8-bit BGR, linear light (EXR, floating-point TIFF) through
    one tone curve (`tone.tone_curve`); the orientation that EXIF or the container states is applied.

    Args:
        source: a video file; a folder of images, in natural order (img2 before img10), whose other files are ignored;
            an iterable of images, (h, w), (h, w, 3) or (h, w, 4), uint8 or uint16; or an iterable of `Frame` objects,
            which keep their index, name and timestamp.
        frames: the range to read, for example ``slice(0, 100, 2)``; no negative numbers. It counts as the frames do
            (`Frame.index`): ``slice(1001, 1101)`` are the first 100 frames of a sequence that begins at 1001.
        fields: what is done with interlaced video. "auto" takes its fields apart: twice the frames, half the lines;
            "apart" does so with any video, "blend" keeps frames whole and blends their fields.
        pixel_aspect: width of a shown pixel over its height (of whole frames, upright), in place of what the container
            or the header of a plate says.

    Raises:
        InputError: at the call, if an option has no such value, or if the source does not exist, is not a video or
            holds no images; while iterating, if an image is unreadable or truncated, if a frame has another size than
            the first one, or if there is no frame.
    """
    selection = checked_range(frames if frames is not None else slice(None))
    check_footage(fields, pixel_aspect)
    if isinstance(source, (str, Path)):
        path = Path(source)
        if path.is_dir():
            found = with_aspect(_folder_frames(chosen(numbered_images(path), selection)), pixel_aspect)
        elif path.is_file():
            if path.suffix.lower() in IMAGE_SUFFIXES | (UNREAD_SUFFIXES - {".gif"}):
                raise InputError(f"{path} is a single image; a video file or a folder of images is expected")
            found = with_aspect(decode(open_video(path), selection, fields), pixel_aspect)
        else:
            problem = "is neither a file nor a folder" if path.exists() else "does not exist"
            if _PATTERN.search(path.name) and path.parent.is_dir():
                problem = f"is a pattern of names in {path.parent}"
            raise InputError(f"{path} {problem}; a video file or a folder of images is expected")
        return uniform(found, str(path), selection.start)
    if isinstance(source, np.ndarray) and (source.ndim == 2 or (source.ndim == 3 and source.shape[-1] in (3, 4))):
        raise InputError(f"an array of shape {source.shape} is a single image; a sequence of images is expected")
    if not isinstance(source, Iterable):
        raise InputError(
            f"frames cannot be read from a {type(source).__name__}; "
            "a video file, a folder of images or an iterable of images is expected"
        )
    return uniform(
        with_aspect(_array_frames(source, selection), pixel_aspect), "the sequence of images", selection.start
    )


def check_footage(fields: str, pixel_aspect: float | None) -> None:
    """Refuse what is no way to read footage.

    Raises:
        InputError: an option has no such value.
    """
    if fields not in get_args(Fields):
        raise InputError(f"unknown fields '{fields}', expected one of {', '.join(get_args(Fields))}")
    if pixel_aspect is not None:
        check_pixel_aspect(pixel_aspect)


def uniform(frames: Iterator[Frame], source: str, start: int) -> Iterator[Frame]:
    """The same frames, checked to be one or more, of the same size.

    Args:
        source, start: name of the source and first frame of the range, for the error messages.

    Raises:
        InputError: while iterating, if a frame has another size than the first one, or if there is none.
    """
    first: Frame | None = None
    for frame in frames:
        first = first or frame
        (height, width), (first_height, first_width) = frame.image.shape[:2], first.image.shape[:2]
        if (height, width) != (first_height, first_width):
            raise InputError(
                f"frame {frame.index} ({frame.name}) of {source} has {width}x{height} pixels, "
                f"but the first one ({first.name}) has {first_width}x{first_height}"
            )
        yield frame
    if first is None:
        raise InputError(f"{source} holds no frames" + (f" from number {start} on" if start else ""))


def with_aspect(frames: Iterator[Frame], pixel_aspect: float | None) -> Iterator[Frame]:
    """The frames with another pixel aspect, which is that of whole frames; None leaves them as they are."""
    for frame in frames:
        if pixel_aspect is None:
            yield frame
        else:
            yield replace(frame, pixel_aspect=pixel_aspect * (0.5 if frame.is_field else 1.0))


def _array_frames(
    images: Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame], selection: slice
) -> Iterator[Frame]:
    taken = itertools.islice(enumerate(images), selection.start, selection.stop, selection.step)
    for index, image in taken:
        if isinstance(image, Frame):
            yield replace(image, image=bgr_image(image.image, index))
        else:
            yield Frame(index, bgr_image(image, index), f"{index:06d}")


def _folder_frames(images: list[FrameFile]) -> Iterator[Frame]:
    for number, path, time in images:
        yield Frame(number, read_image(path), path.name, time, path=path, pixel_aspect=stated_pixel_aspect(path))
