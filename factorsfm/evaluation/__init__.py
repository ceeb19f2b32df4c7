"""What judges a reconstruction: metrics, readers of data sets, baselines, degraded footage and useless priors.

Takes and gives numpy arrays; `pose_arrays` converts poses to them. May import `api` and what lies below it; only the
command line imports it.
"""

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
from factorsfm.support.similarity import Similarity, align, pose_arrays

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
