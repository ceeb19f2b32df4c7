"""Frames of a shot, from a video file, a folder of images or an iterable of images."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.folders import IMAGE_SUFFIXES, read_image
from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.frames.numbering import chosen, numbered_images
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.video import decode, has_timestamps
from factorsfm.support.errors import InputError

# FFmpeg reports broken files on stderr, past all Python logging. A level that the user has set stays.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def read_frames(
    source: str | Path | Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame], frames: slice | None = None
) -> Iterator[Frame]:
    """Read the frames of a shot one by one, in bounded memory.

    Grey, 16-bit and alpha images become 8-bit BGR, linear light (EXR, floating-point TIFF) through one tone curve
    (`tone.tone_curve`); the EXIF orientation is applied.

    Args:
        source: a video file; a folder of images, in natural order (img2 before img10), whose other files are ignored;
            an iterable of images, (h, w), (h, w, 3) or (h, w, 4), uint8 or uint16; or an iterable of `Frame` objects,
            which keep their index, name and timestamp.
        frames: the range to read, for example ``slice(0, 100, 2)``; no negative numbers. It counts as the frames do
            (`Frame.index`): ``slice(1001, 1101)`` are the first 100 frames of a sequence that begins at 1001.

    Raises:
        InputError: at the call, if the source does not exist, is not a video or holds no images; while iterating, if an
            image is unreadable or truncated, if a frame has another size than the first one, or if there is no frame.
    """
    selection = checked_range(frames if frames is not None else slice(None))
    if isinstance(source, (str, Path)):
        path = Path(source)
        if path.is_dir():
            found = _folder_frames(chosen(numbered_images(path), selection))
        elif path.is_file():
            if path.suffix.lower() in IMAGE_SUFFIXES:
                raise InputError(f"{path} is a single image; a video file or a folder of images is expected")
            found = _video_frames(path, selection, timed=has_timestamps(path))
        else:
            raise InputError(f"{path} does not exist; a video file or a folder of images is expected")
        return uniform(found, str(path), selection.start)
    if isinstance(source, np.ndarray) and (source.ndim == 2 or (source.ndim == 3 and source.shape[-1] in (3, 4))):
        raise InputError(f"an array of shape {source.shape} is a single image; a sequence of images is expected")
    if not isinstance(source, Iterable):
        raise InputError(
            f"frames cannot be read from a {type(source).__name__}; "
            "a video file, a folder of images or an iterable of images is expected"
        )
    return uniform(_array_frames(source, selection), "the sequence of images", selection.start)


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


def _array_frames(
    images: Iterable[NDArray[np.uint8] | NDArray[np.uint16] | Frame], selection: slice
) -> Iterator[Frame]:
    taken = itertools.islice(enumerate(images), selection.start, selection.stop, selection.step)
    for index, image in taken:
        if isinstance(image, Frame):
            yield replace(image, image=bgr_image(image.image, index))
        else:
            yield Frame(index, bgr_image(image, index), f"{index:06d}")


def _folder_frames(images: list[tuple[int, Path]]) -> Iterator[Frame]:
    for number, path in images:
        yield Frame(number, read_image(path), path.name, path=path)


def _video_frames(path: Path, selection: slice, *, timed: bool) -> Iterator[Frame]:
    for index, image, timestamp in decode(path, selection, timed=timed):
        yield Frame(index, bgr_image(image, index), f"{index:06d}", timestamp)
