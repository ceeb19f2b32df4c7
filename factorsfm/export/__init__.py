"""Files for other tools: by format name through `export`, or through the writer of a format.

Takes a `Reconstruction`, gives files. May import `result` and the rooms below it.
"""

from factorsfm.export.colmap import write_colmap
from factorsfm.export.formats import FORMATS, Format, export
from factorsfm.export.options import ExportOptions
from factorsfm.export.ply import write_ply
from factorsfm.export.trajectory import write_trajectory
from factorsfm.support.up_axis import UpAxis

__all__ = [
    "FORMATS",
    "ExportOptions",
    "Format",
    "UpAxis",
    "export",
    "write_colmap",
    "write_ply",
    "write_trajectory",
]
