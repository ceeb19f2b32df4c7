"""What a person looks at: the HTML report and the picture."""

from factorsfm.report.page import report_html
from factorsfm.report.picture import draw_picture

__all__ = ["draw_picture", "report_html"]
