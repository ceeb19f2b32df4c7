"""The frame of all pages: one self-contained HTML file that needs no network."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from factorsfm.support.json_text import as_text, json_text

_DATA = re.compile(r'(?<=<script type="application/json" id="data">).*?(?=</script>)', re.DOTALL)


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


def script_text(data: Mapping[str, Any]) -> str:
    """Data as the text of a script element."""
    return json_text(data, indent=None).replace("</", "<\\/")  # the browser takes "</" for the end of the element


def data_of(page: str) -> dict[str, Any]:
    """The data in the text of a report.

    Raises:
        ValueError: there are none, or they are damaged.
    """
    match = _DATA.search(page)
    if match is None:
        raise ValueError("a report without data")
    data: dict[str, Any] = json.loads(match[0])
    return data


def with_data(page: str, data: Mapping[str, Any]) -> str:
    """The text of a report with other data."""
    return _DATA.sub(lambda _: script_text(data), page)
