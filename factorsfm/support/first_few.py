"""The first of many names, for a sentence."""

from __future__ import annotations

from collections.abc import Sequence


def first_few(names: Sequence[object], most: int) -> str:
    """Names with commas between them; where there are more than `most`, an ellipsis in the place of the others."""
    return ", ".join(map(str, names[:most])) + (", …" if len(names) > most else "")
