"""Worlds and cameras of other tools beside those of a reconstruction, which have OpenCV's axes: y down, z ahead."""

from __future__ import annotations

from enum import StrEnum

import numpy as np


class UpAxis(StrEnum):
    """The world axis that points up in the first frame; the world is right-handed and its x axis points right."""

    Y = "y"  # x right, y up, z towards the viewer: Nuke, USD, Alembic
    Z = "z"  # x right, y into the picture, z up: Blender, nerfstudio
    MINUS_Y = "-y"  # x right, y down, z into the picture: OpenCV, COLMAP, After Effects, the reconstruction itself


TURNED_WORLD = {  # the other world from the reconstruction's
    UpAxis.MINUS_Y: np.eye(3),
    UpAxis.Y: np.diag([1.0, -1.0, -1.0]),
    UpAxis.Z: np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
FILM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV camera axes from those of film tools: y up, looking along -z
