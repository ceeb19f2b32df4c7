"""The HTML report, the overlay, the picture, and the folder of a result.

Takes a `Reconstruction`, gives files. May import `export` and the rooms below it.
"""

from factorsfm.report.page import failure_html, report_html
from factorsfm.report.picture import draw_picture
from factorsfm.report.thumbnails import Thumbnails

__all__ = ["Thumbnails", "draw_picture", "failure_html", "report_html"]
