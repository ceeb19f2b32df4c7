"""What a reconstruction is made from, opened and checked before the long work."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.known import Control
from factorsfm.control.located import find_frames
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.numbering import chosen, first_number_of, numbered_images
from factorsfm.frames.ranges import checked_range, range_text
from factorsfm.frames.reading import read_frames
from factorsfm.inertial.recording import ImuRecording
from factorsfm.mending.user_tracks import UserTracks
from factorsfm.priors.depth import DepthFolder, DepthPrior
from factorsfm.priors.masks import MaskFolder, MaskPrior
from factorsfm.priors.object_masks import FROM_MOTION, ObjectFolder, ObjectMasks
from factorsfm.support.errors import InputError
from factorsfm.support.options import Options

Source = str | Path | Iterable[Frame | NDArray[np.uint8]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """Everything that `api.reconstruct` takes, opened; what does not go together is refused.

    Attributes:
        source: of the frames; frames: its range, None for all; fields, pixel_aspect: see `read_frames`.
        unordered: whether the images are in no order of time.
        camera, depth, masks, control, tracks, imu: None where there is none.
        objects: masks of things that move by themselves; from_motion: whether these are found by their motion.
        features, work: of images in any order, see `api.reconstruct`.

    Raises:
        InputError: some of it does not go together, or the control names frames that a folder does not have.
    """

    source: Source
    frames: slice | None
    fields: Fields
    pixel_aspect: float | None
    unordered: bool
    camera: pycolmap.Camera | None
    depth: DepthPrior | None
    masks: MaskPrior | None
    objects: ObjectMasks | None
    from_motion: bool
    control: Control | None
    tracks: UserTracks | None
    imu: ImuRecording | None
    features: str | Path
    work: str | Path | None
    options: Options

    def __post_init__(self) -> None:
        self._check_control()
        if self.unordered and self.imu is not None:
            raise InputError("an IMU goes with a video; images in any order have no times")
        if self.unordered and self.tracks is not None:
            raise InputError("tracks of your own go with a video; images in any order are matched with each other")
        if self.camera is None and self.tracks is not None and self.tracks.on == "undistorted":
            raise InputError("tracks on undistorted footage need its lens; a camera, or tracks on the footage as it is")
        if self.unordered and (self.objects is not None or self.from_motion):
            raise InputError("objects are tracked in a video; images in any order show no motion")
        if self.unordered and (self.fields != "auto" or self.pixel_aspect is not None):
            raise InputError("fields and pixel aspect are of a shot; images in any order take their pixels as square")
        if self.from_motion and isinstance(self.source, Iterator):
            raise InputError("objects that move by themselves need frames that can be read twice, not an iterator")

    def _check_control(self) -> None:
        """A folder has all frames that the control names."""
        if self.control is None or not isinstance(self.source, str | Path) or not Path(self.source).is_dir():
            return
        folder = Path(self.source)
        if self.unordered:
            names = [(index, path.name) for index, path in enumerate(list_images(folder))][self.frames or slice(None)]
        else:
            images = chosen(numbered_images(folder), self.frames or checked_range(slice(None)))
            names = [(image.number, image.path.name) for image in images]
        find_frames(self.control, names)

    def footage(self) -> Iterator[Frame]:
        """The frames of a shot; a file or folder is read from its beginning each time."""
        return read_frames(self.source, self.frames, fields=self.fields, pixel_aspect=self.pixel_aspect)

    def described(self) -> dict[str, Any]:
        """What is written beside the options of a result."""
        return {
            "source": str(Path(self.source).absolute()) if isinstance(self.source, str | Path) else "frames",
            "unordered": self.unordered,
            "features": str(self.features),
            "tracks": None if self.tracks is None else self.tracks.source,
            "objects": FROM_MOTION if self.from_motion else _name_of(self.objects),
            **input_options(self.source, self.depth, self.masks, self.frames, self.fields, self.pixel_aspect),
        }

    def check_matched(self) -> None:
        """As `check_matched`."""
        check_matched(self.source, self.depth, self.masks, self.objects)


def input_options(
    source: object,
    depth: DepthPrior | None,
    masks: MaskPrior | None,
    frames: slice | None,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
) -> dict[str, Any]:
    """What is written beside the options of a result.

    The number that a sequence begins with, the names of the priors, the range, and how footage was read.
    """
    return {
        "first_number": first_number_of(source),
        "depth": depth.name if depth is not None else None,
        "depth_kind": str(depth.kind) if depth is not None else None,
        "masks": _name_of(masks),
        "frames": range_text(frames) if frames is not None else None,
        "fields": fields,
        "pixel_aspect": pixel_aspect,
    }


def _name_of(masks: MaskPrior | ObjectMasks | None) -> str | None:
    return getattr(masks, "name", type(masks).__name__) if masks is not None else None


def check_matched(
    source: object, depth: DepthPrior | None, masks: MaskPrior | None, objects: ObjectMasks | None = None
) -> None:
    """After all frames: a folder of maps or masks of which none belongs to a frame is an InputError."""
    for name, folder in (("depth map", depth), ("mask", masks), ("mask of an object", objects)):
        if isinstance(folder, DepthFolder | MaskFolder | ObjectFolder) and folder.asked and not folder.matched:
            raise InputError(f"no {name} in the given folder matches a frame of {source}")
