"""What a frame shows by its container: one flat view, or a sphere or two views, which no lens shows so."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import av
from av.buffer import Buffer
from av.sidedata.sidedata import Type

from factorsfm.support.errors import InputError

# Projections and stereo packings as FFmpeg counts them; others are flat, or one view alone.
_SPHERES = {0: "equirectangular", 1: "cube map", 2: "equirectangular", 3: "half equirectangular"}
_PACKINGS = {
    1: "side by side",
    2: "one above the other",
    4: "as a checkerboard",
    5: "side by side",
    6: "in lines",
    7: "in columns",
}


def check_is_one_view(frame: av.VideoFrame, path: Path) -> None:
    """Refuse a video whose frames are marked to hold more than a lens shows.

    Args:
        frame: its first one; path: for the message.

    Raises:
        InputError: it shows a sphere, or two views for stereo.
    """
    sphere = _SPHERES.get(_first_number(frame, Type.SPHERICAL))
    if sphere is not None:
        raise InputError(
            f"{path} is a 360 degree video ({sphere}), which no lens shows so; make a flat view of it, 90 degrees wide"
        )
    packing = _PACKINGS.get(_first_number(frame, Type.STEREO3D))
    if packing is not None:
        raise InputError(f"{path} holds two views in each frame ({packing}); cut one of them out")


def _first_number(frame: av.VideoFrame, kind: Type) -> int:
    """The number with which side data begin, -1 without them."""
    data = cast("Mapping[Type, Buffer]", frame.side_data).get(kind)
    return -1 if data is None else int(struct.unpack_from("=i", bytes(data))[0])
