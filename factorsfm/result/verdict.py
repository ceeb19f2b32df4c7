"""The grade of a result, with its reasons: one for the terminal, for summary.json and for the report."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from factorsfm.result.reconstruction import Reconstruction

_DOUBTFUL_PX = 1.0  # median reprojection error; good tracks have 0.1 pixels


class Grade(StrEnum):
    """What a result can be used for, in one to three words."""

    SOLVED = "Solved"
    IN_PART = "Solved in part"
    DOUBTFUL = "Doubtful"
    NOT_SOLVED = "Not solved"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The grade of a result; `doubts`: why it is doubtful, in sentences."""

    grade: Grade
    doubts: list[str]


def verdict_of(reconstruction: Reconstruction) -> Verdict:
    """Doubtful where tracks do not fit or the images leave open what the camera does; else how much is solved."""
    registered = len(reconstruction.registered)
    if not registered:
        return Verdict(Grade.NOT_SOLVED, [])
    doubts = list(reconstruction.doubts)
    if (error := _misfit(reconstruction)) > _DOUBTFUL_PX:
        doubts.insert(
            0,
            f"Half of the tracks miss by more than {error:.2f} pixels: they contradict each other, or the scene moves "
            "by itself.",
        )
    if doubts:
        return Verdict(Grade.DOUBTFUL, doubts)
    return Verdict(Grade.SOLVED if registered == len(reconstruction.frames) else Grade.IN_PART, [])


def median_reprojection_error(reconstruction: Reconstruction) -> float:
    """Median over all observations, pixels; NaN without observations."""
    errors = reconstruction.observation_error
    errors = errors[np.isfinite(errors)]
    return float(np.median(errors)) if len(errors) else float("nan")


def _misfit(reconstruction: Reconstruction) -> float:
    """Median reprojection error without what a rolling shutter adds to it where poses fit the recorded images."""
    shutter = reconstruction.shutter
    if shutter is not None and np.isfinite(shutter.reprojection_error):
        return shutter.reprojection_error
    return median_reprojection_error(reconstruction)
