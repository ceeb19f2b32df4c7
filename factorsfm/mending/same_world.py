"""A result that is solved again, in the world and the unit of the one before: what was built there stays in place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorsfm.alignment.planes import find_plane
from factorsfm.result.alignment import FREE_SCALE, Alignment
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.rotations import nearest_rotation
from factorsfm.support.similarity import Similarity, pose_arrays


def in_world_of(known: Reconstruction, solved: Reconstruction) -> Reconstruction:
    """The solved result where cameras and points lie as those of the known one; that of its control stays.

    Lengths that control has given stay, too: the known world is in their unit then, its origin where it was.
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
    scale, unit = 1.0, 1.0  # of the solved lengths, and of the known ones
    if len(mine):
        away = np.linalg.norm(solved.points[mine] - centers[0], axis=1)
        scale = float(np.median(np.linalg.norm(known.points[other] - known_centers[0], axis=1) / away))
    has_lengths = solved.control is not None and np.isfinite(solved.control.scale_std)
    if has_lengths:
        scale, unit = 1.0, 1.0 / scale
    shift = unit * known_centers - scale * centers @ rotation.T
    moved = in_other_world(solved, Similarity(scale, rotation, np.median(shift, axis=0)))
    if known.alignment is not None:
        moved.alignment = _alignment(known.alignment, moved, unit)
    return moved if has_lengths else replace(moved, imu=known.imu, metric=known.metric)


def _alignment(known: Alignment, moved: Reconstruction, unit: float) -> Alignment:
    """What was known of the world, of which now other cameras and points may be left, and all lengths `unit` times."""
    now = known.in_unit(unit)
    if moved.control is not None and np.isfinite(moved.control.scale_std):
        notes = [note for note in now.notes if note != FREE_SCALE]
        now = replace(now, scale_from="control", scale_std=moved.control.scale_std, notes=notes)
    if now.ground_height is None:
        return now
    height = -float(moved.camera_centers()[0][1]) - now.ground_height
    plane = find_plane(replace(moved, alignment=now))
    points = len(plane.support) if plane.kind == "ground" and now.ground_from == "points" else now.ground_points
    return replace(now, camera_height=height, ground_points=points)
