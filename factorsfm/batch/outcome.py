"""The outcome of a shot, read from its result folder."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from factorsfm.report.document import data_of
from factorsfm.result.verdict import Grade
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json, typed

_THUMBNAIL_WIDTH = 240
_QUALITY = 70  # of JPEG


@dataclass(frozen=True, slots=True)
class Outcome:
    """The summary of a shot, with `verdict` if it is reconstructed and `reason` otherwise."""

    reconstructed: bool
    grade: Grade
    frames: int
    registered: int
    seconds: dict[str, float]
    verdict: str = ""
    reason: str = ""
    parallax: float = math.nan
    options: dict[str, Any] = field(default_factory=dict)


def read_outcome(folder: Path) -> Outcome:
    """Read the summary of a result folder.

    Raises:
        InputError: there is no summary, or it is damaged.
    """
    return typed(Outcome, read_json(folder / "summary.json", "the summary"), "summary.json")


def is_result_of(job: dict[str, Any], folder: Path) -> bool:
    """Whether a folder holds the complete result of the job with this description, see `Job.to_dict`."""
    try:
        return read_outcome(folder).options.get("job") == job and (folder / "report.html").is_file()
    except InputError:
        return False


def thumbnail(report: Path) -> bytes | None:
    """The middle picture of a report as a small JPEG, or None."""
    try:
        pictures = [text for text in data_of(report.read_text(encoding="utf-8"))["thumbnail"] if text]
        data = base64.b64decode(pictures[len(pictures) // 2]) if pictures else b""
    except (OSError, ValueError, LookupError, TypeError):  # the report is missing or damaged
        return None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        return None
    height, width = image.shape[:2]
    size = (_THUMBNAIL_WIDTH, max(1, round(height * _THUMBNAIL_WIDTH / width)))
    _, jpeg = cv2.imencode(
        ".jpg", cv2.resize(image, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    )
    return jpeg.tobytes()
