"""Rotations as Euler angles of film tools, in degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def angles_zxy(rotation: Array) -> Array:
    """(k, 3) degrees about x, y, z with ``rotation = Ry @ Rx @ Rz``: first z, then x, then y (Nuke's ZXY).

    Unwrapped: no jumps of 360 degrees between rows.

    Args:
        rotation: (k, 3, 3).
    """
    # Exchanging x and y turns Ry Rx Rz into Rx Ry Rz. It is a reflection, so it negates every angle.
    swapped = rotation[:, [1, 0, 2]][:, :, [1, 0, 2]]
    y, x, z = _angles(swapped).T
    return _without_jumps(np.column_stack([-x, -y, -z]))


def angles_zyx(rotation: Array) -> Array:
    """(k, 3) degrees about x, y, z with ``rotation = Rx @ Ry @ Rz``: first z, then y, then x (After Effects).

    Unwrapped: no jumps of 360 degrees between rows.

    Args:
        rotation: (k, 3, 3).
    """
    return _without_jumps(_angles(rotation))


def _angles(rotation: Array) -> Array:
    """(k, 3) radians (a, b, c) with ``rotation = Rx(a) @ Ry(b) @ Rz(c)``."""
    b = np.arctan2(rotation[:, 0, 2], np.hypot(rotation[:, 0, 0], rotation[:, 0, 1]))
    a = np.arctan2(-rotation[:, 1, 2], rotation[:, 2, 2])
    c = np.arctan2(-rotation[:, 0, 1], rotation[:, 0, 0])
    return np.column_stack([a, b, c])


def _without_jumps(radians: Array) -> Array:
    return np.asarray(np.degrees(np.unwrap(radians, axis=0)) + 0.0, dtype=np.float64)  # + 0: no negative zeros
