"""Files for other tools: trajectory, COLMAP model, point cloud, and the folder that holds them all."""

from factorsfm.export.colmap import write_colmap
from factorsfm.export.folder import check_directory, write_failure, write_folder
from factorsfm.export.ply import write_ply
from factorsfm.export.trajectory import write_trajectory

__all__ = [
    "check_directory",
    "write_colmap",
    "write_failure",
    "write_folder",
    "write_ply",
    "write_trajectory",
]
