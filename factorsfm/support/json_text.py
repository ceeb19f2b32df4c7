"""Valid JSON from numpy values, paths and non-finite numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def json_text(value: Any, indent: int | None = 1) -> str:
    """Valid JSON: NaN and infinity become null, numpy values become numbers and lists, everything else its string."""
    separators = (",", ":") if indent is None else None
    return json.dumps(_plain(value), indent=indent, separators=separators, allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {as_text(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    return as_text(str(value))


def is_text(value: str) -> bool:
    """Whether a string can be written as UTF-8; a file name of other bytes cannot."""
    return value == as_text(value)


def as_text(value: str) -> str:
    """The same with escapes in place of what cannot be written as UTF-8."""
    return value.encode("utf-8", "backslashreplace").decode("utf-8")
