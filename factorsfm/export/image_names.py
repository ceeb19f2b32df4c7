"""Names of image files for the frames of a result."""

from __future__ import annotations

from pathlib import PurePath


def image_name(name: str) -> str:
    """The name of a frame as that of an image file; the frames of a video are named by a number alone."""
    return name if PurePath(name).suffix else f"{name}.png"
