"""Files for other tools: by name through `export`, or one by one; and the result folder, written and read back."""

from factorsfm.export.colmap import write_colmap
from factorsfm.export.folder import check_directory, write_failure, write_folder
from factorsfm.export.formats import FORMATS, Format, export
from factorsfm.export.options import ExportOptions, UpAxis
from factorsfm.export.ply import write_ply
from factorsfm.export.reading import read_result
from factorsfm.export.trajectory import write_trajectory

__all__ = [
    "FORMATS",
    "ExportOptions",
    "Format",
    "UpAxis",
    "check_directory",
    "export",
    "read_result",
    "write_colmap",
    "write_failure",
    "write_folder",
    "write_ply",
    "write_trajectory",
]
