"""The files that hold the images of a result: its own source, and the sources of images that were added later."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from factorsfm.frames.fields import Fields
from factorsfm.support.json_reading import typed


@dataclass(frozen=True, slots=True)
class AddedImages:
    """Images that were added to a result; its options hold a list of these under "added".

    Attributes:
        source: the folder or video file, None if the images were arrays.
        first: index in the result of image 0 of this source.
    """

    source: str | None
    first: int


@dataclass(frozen=True, slots=True)
class ImageSource:
    """A folder or a video file that holds images of a result.

    Attributes:
        path: None if the images were arrays.
        first: index in the result of image 0 of this source.
        stop: index in the result of image 0 of the next source.
    """

    path: Path | None
    first: int
    stop: float

    def holds(self, index: int) -> bool:
        """Whether the image with this index in the result is from this source."""
        return self.first <= index < self.stop


def added_images(options: Mapping[str, Any]) -> list[AddedImages]:
    """The images that were added to a result with these options, in order.

    Raises:
        InputError: the options are damaged.
    """
    return typed(list[AddedImages], options.get("added", []), "options.added")


def image_sources(main: Path, options: Mapping[str, Any]) -> list[ImageSource]:
    """All sources of a result.

    Args:
        main: the folder or video file that was reconstructed; options: of the result.

    Raises:
        InputError: the options are damaged.
    """
    added = added_images(options)
    starts = [0, *(part.first for part in added)]
    paths = [main, *(None if part.source is None else Path(part.source) for part in added)]
    return [
        ImageSource(path, first, stop) for path, first, stop in zip(paths, starts, [*starts[1:], math.inf], strict=True)
    ]


def footage_of(options: Mapping[str, Any]) -> list[object]:
    """Whatever a result with these options says that its images are from; not all of it needs to be a path.

    Raises:
        InputError: the options are damaged.
    """
    return [options.get("source"), *(part.source for part in added_images(options))]


def fields_of(options: Mapping[str, Any]) -> Fields:
    """How the footage of a result with these options was read, see `read_frames`: its frames are counted so."""
    said = options.get("fields")
    return next((known for known in get_args(Fields) if known == said), "auto")
