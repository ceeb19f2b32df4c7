"""What a person looks at: the HTML report and the picture."""

from factorsfm.report.page import failure_html, report_html
from factorsfm.report.picture import draw_picture
from factorsfm.report.thumbnails import Thumbnails

__all__ = ["Thumbnails", "draw_picture", "failure_html", "report_html"]
