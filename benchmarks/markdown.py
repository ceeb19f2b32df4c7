"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np


def table(header: Sequence[str], rows: Iterable[Sequence[Any]], best: Callable[..., float] | None = None) -> str:
    """A Markdown table.

    Args:
        best: max or min, whose result is bold in each column of floats; None for no bold cells.
    """
    rows = [list(row) for row in rows]
    marks: dict[int, str] = {}
    if best is not None and len(rows) > 1:
        for column in range(len(header)):
            values = [row[column] for row in rows if isinstance(row[column], float) and np.isfinite(row[column])]
            if len({_text(value) for value in values}) > 1:
                marks[column] = _text(best(values))
    lines = [
        [f"**{text}**" if marks.get(i) == (text := _text(value)) else _text(value) for i, value in enumerate(row)]
        for row in rows
    ]
    align = ["---:" if rows and isinstance(rows[0][i], int | float) else "---" for i in range(len(header))]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [list(header), align, *lines])


def _text(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    if not np.isfinite(value):
        return "–"
    return f"{value:.1f}" if abs(value) < 1000 else f"{value:.0f}"
