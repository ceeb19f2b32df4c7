"""The point cloud as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorsfm.result.reconstruction import Reconstruction

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])


def write_ply(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write all points, world coordinates and colour, as binary little-endian PLY."""
    vertices = np.empty(len(reconstruction.points), _VERTEX)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = reconstruction.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = reconstruction.colors[:, channel]
    header = (
        "ply\n"
        "format binary_little_endian 1.0\n"
        "comment factorsfm\n"
        f"element vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "end_header\n"
    )
    Path(path).write_bytes(header.encode("ascii") + vertices.tobytes())
