"""The pages that people read, and the tables in them."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README, CONTRIBUTING, DOCS = ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs"
PAGES = [README, *sorted(DOCS.glob("*.md"))]
ALL_PAGES = [*PAGES, CONTRIBUTING, ROOT / "CHANGELOG.md", ROOT / "benchmarks" / "README.md"]


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def rows(text: str) -> list[list[str]]:
    """The cells of all table rows."""
    lines = re.findall(r"^\| ?(.*) \|$", text, re.MULTILINE)
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)] for line in lines]


def table(text: str, first_column: str) -> list[dict[str, str]]:
    """The rows of the first table whose first column has this name, by column."""
    body = re.search(rf"^\| {re.escape(first_column)} \|.*\n\|[-:| ]+\|\n((?:\|.*\n)*)", text, re.MULTILINE)
    assert body, first_column
    names, *_ = rows(body[0])
    return [dict(zip(names, row, strict=True)) for row in rows(body[1])]
