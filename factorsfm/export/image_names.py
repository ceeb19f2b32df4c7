"""Names of image files for the frames of a result."""

from __future__ import annotations

from pathlib import PurePath


def image_name(name: str) -> str:
    """Frames of a video are named by a bare number; other programs expect the name of an image file."""
    return name if PurePath(name).suffix else f"{name}.png"
