"""Metrics, data-set readers and baselines: everything that judges a reconstruction.

The metrics take and give numpy arrays; `pose_arrays` makes them of poses.
"""

from factorsfm.evaluation.alignment import Similarity, align, pose_arrays
from factorsfm.evaluation.metrics import (
    DepthErrors,
    TrajectoryErrors,
    auc,
    parallax,
    point_depth_errors,
    recall_curve,
    relative_pose_errors,
    trajectory_errors,
)
from factorsfm.evaluation.readers import read_7scenes, read_colmap, read_eth3d, read_shot, read_studiosfm, read_tum
from factorsfm.evaluation.truth import Shot

__all__ = [
    "DepthErrors",
    "Shot",
    "Similarity",
    "TrajectoryErrors",
    "align",
    "auc",
    "parallax",
    "point_depth_errors",
    "pose_arrays",
    "read_7scenes",
    "read_colmap",
    "read_eth3d",
    "read_shot",
    "read_studiosfm",
    "read_tum",
    "recall_curve",
    "relative_pose_errors",
    "trajectory_errors",
]
