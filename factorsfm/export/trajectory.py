"""The camera path as text, one pose per line."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from factorsfm.export.options import ExportOptions
from factorsfm.export.shot import Shot
from factorsfm.result.reconstruction import FrameResult, Reconstruction


def write_trajectory(reconstruction: Reconstruction, path: str | Path) -> None:
    """Write the registered poses in the TUM format, with the frame index in place of the timestamp.

    One line per registered frame: ``frame_index tx ty tz qx qy qz qw``; camera-to-world, OpenCV axes
    (x right, y down, z forward), world units.
    """
    frames = reconstruction.registered
    _write_tum(path, [str(frame.index) for frame in frames], frames)


def write_tum(shot: Shot, path: Path) -> None:
    """The TUM format: ``seconds tx ty tz qx qy qz qw``, camera-to-world, OpenCV camera axes.

    The time is the frame's timestamp. Without timestamps, or if the user counts the frames (`counts_frames`), it is the
    frame's number divided by the frame rate. Unregistered frames have no line.
    """
    frames = shot.reconstruction.registered
    timed = not counts_frames(shot.options) and all(frame.timestamp is not None for frame in frames)
    times = [frame.timestamp for frame in frames] if timed else [number / shot.fps for number in shot.numbers]
    _write_tum(path, [f"{time:.9f}" for time in times], frames)


def counts_frames(options: ExportOptions) -> bool:
    """Whether the user sets a frame rate or the number of the first frame, in place of the times of the source."""
    return options.fps is not None or options.first_frame is not None


def write_kitti(shot: Shot, path: Path) -> None:
    """The KITTI odometry format: one line per frame, the first three rows of camera-to-world; OpenCV camera axes.

    The line number is the frame, so an unregistered frame has a line, too, with twelve ``nan``.
    """
    rows = np.full((len(shot.reconstruction.frames), 12), np.nan)
    rows[[frame.registered for frame in shot.reconstruction.frames]] = shot.world_from_opencv[:, :3].reshape(-1, 12)
    _write_lines(path, (" ".join(f"{value:.12g}" for value in row) for row in rows))


def _write_tum(path: str | Path, stamps: Iterable[str], frames: Iterable[FrameResult]) -> None:
    lines = []
    for stamp, frame in zip(stamps, frames, strict=True):
        assert frame.cam_from_world is not None
        world_from_cam = frame.cam_from_world.inverse()
        values = (*world_from_cam.translation, *world_from_cam.rotation.quat)
        lines.append(" ".join([stamp, *(f"{value:.12g}" for value in values)]))
    _write_lines(path, lines)


def _write_lines(path: str | Path, lines: Iterable[str]) -> None:
    Path(path).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
