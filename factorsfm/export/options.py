"""What a user may choose about an export."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from factorsfm.support.errors import InputError

# What every format can hold; beyond, a unit has been mistaken.
_RANGES: dict[str, tuple[float, float, str]] = {
    "fps": (1e-3, 1e6, "frames per second"),
    "first_frame": (-1e9, 1e9, "the number of a frame"),
    "sensor_width": (1e-3, 1e6, "millimetres"),
    "scale": (1e-9, 1e9, "a length"),
}


class UpAxis(StrEnum):
    """The world axis that points upwards in the first frame; the world stays right-handed and its x points right."""

    Y = "y"  # x right, y up, z towards the viewer: Nuke, USD, Alembic
    Z = "z"  # x right, y into the picture, z up: Blender, nerfstudio
    MINUS_Y = "-y"  # x right, y down, z into the picture: OpenCV, COLMAP, After Effects, the reconstruction itself


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Choices for every format; None takes the format's own default (`factorsfm.export.FORMATS`).

    Attributes:
        fps: frames per second; None takes the frame rate of the source where its timestamps tell it, else 24.
        first_frame: number, in the target's timeline, of the first frame of the source (index 0), whether or not that
            frame is part of the reconstruction: so the numbers fit the footage.
        sensor_width: width of the film back in mm. Focal lengths in mm follow from it; the picture does not change.
        up_axis: axis that points upwards in the first frame.
        scale: length in the exported file of one world unit of the reconstruction.
        footage: the shot, a video file or a folder of images; None takes the source that was reconstructed, if it is
            still there.

    Raises:
        InputError: a value that makes no sense.
    """

    fps: float | None = None
    first_frame: int | None = None
    sensor_width: float = 36.0
    up_axis: UpAxis | str | None = None
    scale: float | None = None
    footage: str | Path | None = None

    def __post_init__(self) -> None:
        for name, (low, high, unit) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} is {value:g}; a number from {low:g} to {high:g} ({unit}) is expected")
        if self.up_axis is not None and self.up_axis not in set(UpAxis):
            raise InputError(f'up_axis is "{self.up_axis}"; one of {", ".join(UpAxis)} is expected')
        if self.footage is not None and not Path(self.footage).exists():
            raise InputError(
                f"the footage {self.footage} does not exist; a video file or a folder of images is expected"
            )
