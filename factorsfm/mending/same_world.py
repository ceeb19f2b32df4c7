"""A result that is solved again, in the world and the unit of the one before: what was built there stays in place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.rotations import nearest_rotation
from factorsfm.support.similarity import Similarity, pose_arrays


def in_world_of(known: Reconstruction, solved: Reconstruction) -> Reconstruction:
    """The solved result where cameras and points lie as those of the known one; that of its control stays.

    Lengths that control has given stay, too.
    """
    if solved.control is not None and solved.control.placed:
        return solved
    poses = {frame.index: frame.cam_from_world for frame in known.registered}
    shared = [frame for frame in solved.registered if frame.index in poses]
    if not shared:
        return solved
    rotations, centers = pose_arrays([frame.cam_from_world for frame in shared])
    known_rotations, known_centers = pose_arrays([poses[frame.index] for frame in shared])
    rotation = nearest_rotation((known_rotations @ rotations.transpose(0, 2, 1)).sum(axis=0))
    _, mine, other = np.intersect1d(solved.track_ids, known.track_ids, assume_unique=True, return_indices=True)
    scale = 1.0
    if len(mine) and solved.control is None:
        away = np.linalg.norm(solved.points[mine] - centers[0], axis=1)
        scale = float(np.median(np.linalg.norm(known.points[other] - known_centers[0], axis=1) / away))
    shift = known_centers - scale * centers @ rotation.T
    moved = in_other_world(solved, Similarity(scale, rotation, np.median(shift, axis=0)))
    if solved.control is not None:
        return moved
    return replace(moved, alignment=known.alignment, imu=known.imu, metric=known.metric)
