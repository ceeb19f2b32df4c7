"""Frames between those that are solved: their poses on the points of a solution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.lens.turning import turn_to
from factorsfm.mapping.registration import register_image
from factorsfm.support.options import MapperOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pose = tuple[Array, Array]


@dataclass(frozen=True, slots=True)
class PoseOnPoints:
    """A frame between others.

    Attributes:
        row: of the frame.
        pose: rotation and translation, `cam_from_world`.
        inliers, tracks: how many of its tracks the pose explains, and how many it has. With too few of either, the pose
            is that of the nearest solved frame, moved on as the map says.
    """

    row: int
    pose: Pose
    inliers: int
    tracks: int


def poses_on_points(
    solved: State, rows: Index, seen: Observations, cameras: State, turns: Array,
    *, moves: bool, sigma: float, options: MapperOptions,
) -> Iterator[PoseOnPoints]:  # fmt: skip
    """The poses of all other frames.

    Args:
        solved: with the poses of some frames and the points; rows: (ascending) of these frames among all.
        seen: the points in all frames; cameras: a state with the lens of all frames.
        turns: (k, 3, 3) rotations of all frames in the map, of which those from frame to frame count.
        moves: whether the camera does more than turn; sigma: of an observation, pixels.
    """
    xy, focal, points = cameras.normalized(seen), cameras.focal, solved.points
    by_frame = seen.rows_by_frame(len(turns))
    for row in np.setdiff1d(np.arange(len(turns)), rows).tolist():
        mine = by_frame[row]
        nearest = int(np.argmin(np.abs(rows - row)))
        turn = turns[row] @ turns[rows[nearest]].T
        near = turn @ solved.rotation[nearest], turn @ solved.translation[nearest]
        pose, inliers, point = near, 0, seen.point[mine]
        if len(mine) >= options.min_inliers and moves:
            found = register_image(
                points[point], xy[mine], *near,
                focal=float(focal[row]), sigma=max(sigma, SMALLEST_SIGMA_PX), inlier_px=options.inlier_px,
            )  # fmt: skip
            pose, inliers = (found.rotation, found.translation), int(found.inliers.sum())
        elif len(mine) >= options.min_inliers:
            pose, inliers = _turned(solved.bearing[point], xy[mine], near[0], float(focal[row]), options.inlier_px)
        yield PoseOnPoints(row, pose if inliers >= options.min_inliers else near, inliers, len(mine))


def _turned(bearing: Array, xy: Array, near: Array, focal: float, inlier_px: float) -> tuple[Pose, int]:
    """The pose of a camera that does not translate, and the number of its inliers."""
    ray = np.column_stack([xy, np.ones(len(xy))])
    rotation = turn_to(bearing, ray / np.linalg.norm(ray, axis=1, keepdims=True), near, focal)
    q = bearing @ rotation.T
    error = focal * np.linalg.norm(q[:, :2] / q[:, 2:] - xy, axis=1)
    return (rotation, np.zeros(3)), int(((error < inlier_px) & (q[:, 2] > 0.0)).sum())
