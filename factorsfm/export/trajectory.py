"""The camera path as text, one pose per line."""

from __future__ import annotations

from pathlib import Path

from factorsfm.reconstruction import Reconstruction


def write_trajectory(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered poses in the TUM format, with the frame index in place of the timestamp.

    One line per registered frame: ``frame_index tx ty tz qx qy qz qw``; camera-to-world, OpenCV axes
    (x right, y down, z forward), world units.
    """
    lines = []
    for frame in reconstruction.frames:
        if frame.cam_from_world is not None:
            world_from_cam = frame.cam_from_world.inverse()
            values = (*world_from_cam.translation, *world_from_cam.rotation.quat)
            lines.append(" ".join([str(frame.index), *(f"{value:.12g}" for value in values)]) + "\n")
    Path(path).write_text("".join(lines), encoding="utf-8")
