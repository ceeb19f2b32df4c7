"""Rows of results by name, kept in a file so that only what is asked for is measured again, and drawn as tables."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Row = dict[str, Any]


class KeptRows:
    """The rows of a benchmark in a JSON file, and their report beside it.

    Args:
        name: of the files in `benchmarks/results`: ``name.json`` and, in capitals, ``NAME.md``.
        report: the Markdown text of all rows.
    """

    def __init__(self, name: str, report: Callable[[dict[str, Row]], str]) -> None:
        folder = Path(__file__).parent / "results"
        self._stored, self._drawn = folder / f"{name}.json", folder / f"{name.upper()}.md"
        self._rows: dict[str, Row] = json.loads(self._stored.read_text()) if self._stored.exists() else {}
        self._report = report

    def keep(self, key: str, row: Row) -> None:
        """Add or replace a row, print it, and write both files."""
        self._rows[key] = row
        print(key, row, flush=True)
        self._stored.write_text(json.dumps(self._rows, indent=1) + "\n")
        self._drawn.write_text(self._report(dict(sorted(self._rows.items()))))


def rows_table(first: str, rows: Mapping[str, Row]) -> list[str]:
    """The lines of a Markdown table.

    Args:
        first: heading of the column with the names of the rows.
        rows: by name, all with the same keys, which head the other columns.
    """
    columns = list(next(iter(rows.values()), {}))
    lines = [f"| {key} | {' | '.join(row[c] for c in columns)} |" for key, row in rows.items()]
    return [f"| {first} | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|", *lines, ""]
