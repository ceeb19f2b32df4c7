"""The frame of all pages: one self-contained HTML file that needs no network."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from string import Template

from factorsfm.support.json_text import as_text


def document(title: str, body: str, *, styles: str = "", scripted: bool = False) -> str:
    """A whole page.

    Args:
        title: plain text; body: HTML; styles: CSS besides that of all pages.
        scripted: whether scripts in the body may run.
    """
    page = Template(packaged("factorsfm.report", "document.html")).substitute(
        title=escape(title),
        script_policy="script-src 'unsafe-inline'; " if scripted else "",
        style=packaged("factorsfm.report", "page.css") + styles,
        body=body,
    )
    return as_text(page)


def packaged(package: str, name: str) -> str:
    """The text of a file that is part of a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")
