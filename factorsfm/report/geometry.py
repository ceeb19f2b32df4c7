"""The reconstruction as seen from its first camera, and its tracks: what report and picture draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.result.reconstruction import Reconstruction


@dataclass(frozen=True, slots=True)
class Scene:
    """Cameras and points in the axes of the first registered camera (x right, y down, z forward).

    Attributes:
        centers: (k, 3) camera centres, in the order of the frames.
        rotations: (k, 3, 3) camera-to-scene rotations.
        positions: (k,) places of the cameras in the list of frames.
        points, colors: (n, 3) and (n, 3) uint8 RGB.
        rows: (n,) rows of the points in the reconstruction.
    """

    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    positions: NDArray[np.int64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of points of a `Scene` in registered frames, sorted by frame.

    Attributes:
        position: (m,) place of the frame in the list of frames.
        point: (m,) row in `Scene.points`.
        xy: (m, 2) where the footage shows the point, pixels with centres at integers.
        residual: (m, 2) from there to where the solve puts it, pixels.
        prior_residual: (m,) of the depth prior, relative; NaN where there is none.
    """

    position: NDArray[np.int64]
    point: NDArray[np.int64]
    xy: NDArray[np.float64]
    residual: NDArray[np.float64]
    prior_residual: NDArray[np.float64]


_NONE = np.zeros(0, np.int64)


def scene(reconstruction: Reconstruction, max_points: int, listed: NDArray[np.int64] = _NONE) -> Scene:
    """The scene with at most `max_points` points, an even choice of them; points at infinity are left out.

    Args:
        listed: rows of points that are there beside the others.
    """
    posed = [(k, f.cam_from_world) for k, f in enumerate(reconstruction.frames) if f.cam_from_world is not None]
    world_from_cam = np.array([pose.inverse().matrix() for _, pose in posed]).reshape(-1, 3, 4)
    rows = np.flatnonzero(np.isfinite(reconstruction.points).all(axis=1))
    rows = np.union1d(rows[:: max(1, -(-len(rows) // max_points))], np.intersect1d(rows, listed))
    origin, axes = np.zeros(3), np.eye(3)
    if posed:
        origin, axes = world_from_cam[0, :, 3], world_from_cam[0, :, :3]
    return Scene(
        centers=(world_from_cam[:, :, 3] - origin) @ axes,
        rotations=axes.T @ world_from_cam[:, :, :3],
        positions=np.array([position for position, _ in posed], np.int64),
        points=(reconstruction.points[rows] - origin) @ axes,
        colors=reconstruction.colors[rows],
        rows=rows,
    )


def tracks(
    reconstruction: Reconstruction, view: Scene, max_observations: int, listed: NDArray[np.int64] = _NONE
) -> Tracks:
    """The tracks of the scene's points, of an even choice of the points where there are too many observations.

    Args:
        listed: rows of points in the reconstruction whose tracks are there in any case.
    """
    in_list = int(np.isin(reconstruction.observation_point, listed).sum())
    rest = max(max_observations - in_list, max_observations // 4)
    step = max(1, -(-(len(reconstruction.observation_point) - in_list) // rest))
    row_in_scene = np.full(len(reconstruction.points), -1)
    shown = np.flatnonzero((np.arange(len(view.rows)) % step == 0) | np.isin(view.rows, listed))
    row_in_scene[view.rows[shown]] = shown
    registered = np.array([frame.registered for frame in reconstruction.frames], bool)
    point = row_in_scene[reconstruction.observation_point]
    kept = np.flatnonzero((point >= 0) & registered[reconstruction.observation_frame])
    kept = kept[np.argsort(reconstruction.observation_frame[kept], kind="stable")]
    position, xy = reconstruction.observation_frame[kept], reconstruction.observation_xy[kept]
    solved = np.empty((len(kept), 2))
    for k in np.unique(position):
        mine = position == k
        pose = reconstruction.frames[k].cam_from_world
        in_camera = pose * reconstruction.points[reconstruction.observation_point[kept[mine]]]
        camera = reconstruction.camera_of(reconstruction.frames[k])
        solved[mine] = camera.img_from_cam(in_camera) - PIXEL_CENTER
    return Tracks(position, point[kept], xy, solved - xy, reconstruction.prior_residual[kept])


def median_prior_residuals(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """(frames,) median magnitude of the relative depth-prior residual of each frame, NaN where none."""
    medians = np.full(len(reconstruction.frames), np.nan)
    rows = np.flatnonzero(np.isfinite(reconstruction.prior_residual))
    frame_of = reconstruction.observation_frame[rows]
    for position in np.unique(frame_of):
        medians[position] = np.median(np.abs(reconstruction.prior_residual[rows[frame_of == position]]))
    return medians
