"""The reconstruction as seen from its first camera: what report and picture draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.reconstruction import Reconstruction


@dataclass(frozen=True, slots=True)
class Scene:
    """Cameras and points in the axes of the first registered camera (x right, y down, z forward).

    Attributes:
        centers: (k, 3) camera centres, in the order of the frames.
        rotations: (k, 3, 3) camera-to-scene rotations.
        frames: (k,) indices of the frames.
        points, colors: (n, 3) and (n, 3) uint8 RGB.
    """

    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    frames: NDArray[np.int64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


def scene(reconstruction: Reconstruction, max_points: int) -> Scene:
    """The scene with at most `max_points` points, an even choice of them; points at infinity are left out."""
    registered = reconstruction.registered
    world_from_cam = np.array(
        [f.cam_from_world.inverse().matrix() for f in registered if f.cam_from_world is not None]
    ).reshape(-1, 3, 4)
    rows = np.flatnonzero(np.isfinite(reconstruction.points).all(axis=1))
    rows = rows[:: max(1, -(-len(rows) // max_points))]
    origin, axes = np.zeros(3), np.eye(3)
    if registered:
        origin, axes = world_from_cam[0, :, 3], world_from_cam[0, :, :3]
    return Scene(
        centers=(world_from_cam[:, :, 3] - origin) @ axes,
        rotations=axes.T @ world_from_cam[:, :, :3],
        frames=np.array([f.index for f in registered], np.int64),
        points=(reconstruction.points[rows] - origin) @ axes,
        colors=reconstruction.colors[rows],
    )


def median_prior_residuals(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """(frames,) median magnitude of the relative depth-prior residual of each frame, NaN where none."""
    medians = np.full(len(reconstruction.frames), np.nan)
    rows = np.flatnonzero(np.isfinite(reconstruction.prior_residual))
    frame_of = reconstruction.observation_frame[rows]
    for position in np.unique(frame_of):
        medians[position] = np.median(np.abs(reconstruction.prior_residual[rows[frame_of == position]]))
    return medians
