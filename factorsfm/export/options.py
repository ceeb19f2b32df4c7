"""The options of an export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorsfm.priors.masks import MaskPrior
from factorsfm.support.errors import InputError
from factorsfm.support.up_axis import UpAxis

# Values that every format can hold; a value outside has probably another unit.
_RANGES: dict[str, tuple[float, float, str]] = {
    "fps": (1e-3, 1e6, "frames per second"),
    "first_frame": (-1e9, 1e9, "the number of a frame"),
    "sensor_width": (1e-3, 1e6, "millimetres"),
    "scale": (1e-9, 1e9, "a length"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of all formats; None is the default of the format (`factorsfm.export.FORMATS`).

    Attributes:
        fps: frames per second; None takes the frame rate from the timestamps of the source, or 24 without them.
        first_frame: number of the source's first frame in the timeline of the target, even if the reconstruction does
            not include that frame. None keeps the numbers of the files of a numbered sequence: `plate.1043.exr` is
            frame 1043.
        sensor_width: width of the film back in mm. It sets the focal length in mm and does not change the picture.
        up_axis: axis that points up in the first frame.
        scale: length of one world unit of the reconstruction in the exported file.
        footage: the shot, a video file or a folder of images; None takes the source of the reconstruction, if it still
            exists. It may have another size than what was solved, such as the originals of proxies, with the same
            aspect ratio: the lens is scaled. A sequence that has all numbers of a numbered source goes with it by the
            numbers, every other footage frame by frame from the first one on.
        undistorted: of the formats for training (COLMAP, nerfstudio): whether images are written without distortion,
            with pinhole cameras. COLMAP's formats are a model alone without it, and a whole folder with it.
        masks: of the same formats: what trainers are to ignore besides what moves by itself, as `open_masks` takes it.

    Raises:
        InputError: a value is out of range, or the footage does not exist.
    """

    fps: float | None = None
    first_frame: int | None = None
    sensor_width: float = 36.0
    up_axis: UpAxis | str | None = None
    scale: float | None = None
    footage: str | Path | None = None
    undistorted: bool = False
    masks: str | Path | MaskPrior | None = None

    def __post_init__(self) -> None:
        for name, (low, high, unit) in _RANGES.items():
            value = getattr(self, name)
            number = isinstance(value, int | float | np.number)
            if value is not None and not (number and low <= value <= high):
                said = f"{value:g}" if number else repr(value)
                raise InputError(f"{name} is {said}; a number from {low:g} to {high:g} ({unit}) is expected")
        if self.first_frame is not None and not isinstance(self.first_frame, int | np.integer):
            raise InputError(f"first_frame is {self.first_frame}; a whole number is expected")
        if self.up_axis is not None and self.up_axis not in set(UpAxis):
            raise InputError(f'up_axis is "{self.up_axis}"; one of {", ".join(UpAxis)} is expected')
        if self.footage is not None and not Path(self.footage).exists():
            raise InputError(
                f"the footage {self.footage} does not exist; a video file or a folder of images is expected"
            )
