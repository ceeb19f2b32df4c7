"""Footage beside the images that were solved: the originals of proxies, or a sequence where a movie was solved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.export.other_pixels import in_other_pixels
from factorsfm.frames.folders import read_image
from factorsfm.frames.numbering import sequence_of
from factorsfm.frames.reading import read_frames
from factorsfm.result.image_sources import fields_of
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import typed

_ROUNDING_PX = 1.0  # an exact height or width of a proxy is rounded to a whole or an even number


@dataclass(frozen=True, slots=True)
class Numbering:
    """Which frame of the footage is which of a result.

    Attributes:
        source_first: number of the first frame of the source that was solved: 0, but for a numbered sequence.
        footage_first: the same of the footage.
        shift: number of a frame in the footage, less its number in the source.
        timeline: number of a frame in the timeline of a tool, less its number in the source, where files give the
            numbers: those of the footage, else those of the source. None if neither is a numbered sequence.
    """

    source_first: int
    footage_first: int
    shift: int
    timeline: int | None


def of_source(first_number: int | None) -> Numbering:
    """Without other footage; `first_number`: of a source that is a numbered sequence."""
    first = first_number or 0
    return Numbering(first, first, 0, None if first_number is None else 0)


def match_numbers(reconstruction: Reconstruction, footage: Path | None) -> Numbering:
    """Frames with the same numbers belong together if the footage has all of the result's; else first goes on first."""
    said = reconstruction.options.get("first_number")
    own = None if said is None else typed(int, said, "options.first_number")
    if footage is None:
        return of_source(own)
    first, numbers = own or 0, sequence_of(footage)
    if numbers is None:  # it counts from 0
        return Numbering(first, 0, -first, None if own is None else 0)
    indices = {frame.index for frame in reconstruction.frames}
    same = own is not None and indices.issubset(numbers)
    shift = 0 if same else numbers[0] - first
    return Numbering(first, numbers[0], shift, shift)


def at_size_of(reconstruction: Reconstruction, footage: Path) -> Reconstruction:
    """The result as if it had been solved on this footage, of another size and the same aspect ratio.

    Lenses and observations are scaled about the corner of the image, not about the centre of a pixel. Images of several
    sizes are all scaled as the first one is.

    Raises:
        InputError: the aspect ratio is another one, or the footage cannot be read.
    """
    frame = reconstruction.registered[0]
    named = footage / frame.name
    image = (
        read_image(named)
        if named.is_file()
        else next(read_frames(footage, fields=fields_of(reconstruction.options))).image
    )
    camera, (height, width) = reconstruction.camera_of(frame), image.shape[:2]
    if (width, height) == (camera.width, camera.height):
        return reconstruction
    _check_aspect(camera, width, height, footage)
    x, y = width / camera.width, height / camera.height

    def scaled(lens: pycolmap.Camera) -> pycolmap.Camera:
        new = pycolmap.Camera(lens.todict())
        new.rescale(round(x * lens.width), round(y * lens.height))
        return new

    def placed(_: pycolmap.Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((xy + 0.5) * np.array([x, y]) - 0.5)

    new = in_other_pixels(reconstruction, scaled, placed)
    return replace(new, observation_error=reconstruction.observation_error * np.sqrt(x * y))


def _check_aspect(camera: pycolmap.Camera, width: int, height: int, footage: Path) -> None:
    """Refuse a size that is no enlargement of the other one, rounded to whole or even pixels."""
    (w, h), (wide, high) = sorted([(camera.width, camera.height), (width, height)], key=lambda size: size[0] * size[1])
    if min(abs(w * high / wide - h), abs(h * wide / high - w)) > _ROUNDING_PX:
        raise InputError(
            f"the footage {footage} has {width}x{height} pixels (aspect ratio {width / height:.3f}) and the result "
            f"{camera.width}x{camera.height} ({camera.width / camera.height:.3f}): the lens cannot be carried over"
        )
