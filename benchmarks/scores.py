"""Records in groups, and the scores of a group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.store import Record
from factorsfm.evaluation.metrics import (
    ATE_THRESHOLDS,
    R_RPE_THRESHOLDS,
    RELATIVE_POSE_THRESHOLDS,
    T_RPE_THRESHOLDS,
    DepthErrors,
    TrajectoryErrors,
    auc,
    relative_pose_errors,
)

Array = NDArray[np.float64]
Records = Sequence[Record]

_PARALLAX_SHARE = 0.3  # of the shots, that count as those with the largest or the smallest parallax
_WITHIN = 0.05  # largest relative error of a depth that counts as right


class Label(NamedTuple):
    """Method and prior of a row of a table or a line of a figure."""

    method: str
    prior: str

    def __str__(self) -> str:
        return self.method if self.prior == "none" else f"{self.method}, {self.prior}"


def by_label(records: Records) -> dict[Label, list[Record]]:
    """Records by method and prior, in the order of their first occurrence."""
    groups: dict[Label, list[Record]] = {}
    for record in records:
        groups.setdefault(Label(record.cell.method, record.cell.prior), []).append(record)
    return groups


def by_shot(records: Records) -> dict[str, list[Record]]:
    """Records by shot, in the order of the shots' names."""
    groups: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda record: record.cell.shot):
        groups.setdefault(record.cell.shot, []).append(record)
    return groups


def parallax_of(record: Record) -> float | None:
    """True parallax of the frames of a record; None if the shot has no true depth."""
    value: float | None = record.facts["parallax"]
    return value


def smallest_parallax(records: Records) -> list[Record]:
    """The records of the 30 % of the shots with the smallest parallax, but of at least one shot."""
    return _ranked(records, largest=False)


def largest_parallax(records: Records) -> list[Record]:
    """The records of the 30 % of the shots with the largest parallax, but of at least one shot."""
    return _ranked(records, largest=True)


def _ranked(records: Records, largest: bool) -> list[Record]:
    values = {record.cell.shot: value for record in records if (value := parallax_of(record)) is not None}
    ranked = sorted(values, key=lambda shot: values[shot], reverse=largest)
    chosen = ranked[: max(1, round(_PARALLAX_SHARE * len(ranked)))]
    return [record for record in records if record.cell.shot in chosen]


def pooled_errors(records: Records) -> tuple[Array, Array, Array]:
    """ATE, T-RPE and R-RPE of all frames of the records."""
    return _pooled([record.errors for record in records])


def _pooled(errors: Sequence[TrajectoryErrors]) -> tuple[Array, Array, Array]:
    return (
        np.concatenate([e.ate for e in errors]),
        np.concatenate([e.t_rpe for e in errors]),
        np.concatenate([e.r_rpe for e in errors]),
    )


def pose_aucs(records: Records) -> list[float]:
    """The six AUC columns of the paper's table, pooled over all frames."""
    return _aucs(*pooled_errors(records))


def given_aucs(records: Records) -> list[float] | None:
    """The same for the causal poses; None if a record has none."""
    errors = [found for record in records if (found := record.given_errors) is not None]
    return _aucs(*_pooled(errors)) if len(errors) == len(records) else None


def _aucs(*pooled: Array) -> list[float]:
    thresholds = (ATE_THRESHOLDS, T_RPE_THRESHOLDS, R_RPE_THRESHOLDS)
    return [auc(errors, limit) for errors, limits in zip(pooled, thresholds, strict=True) for limit in limits]


def pooled_depth(records: Records) -> dict[str, float]:
    """`DepthErrors.summary` of all points of the records."""
    return DepthErrors.pool(record.depth_errors for record in records).summary()


def within_at_own_scale(records: Records) -> float:
    """Percent of the points within 5 % of the true depth, with the depths of each record scaled to a median ratio of 1.

    It shows how good the shape is if the path is too short to determine the scale by alignment.
    """
    ratios = [errors.estimate / errors.truth for errors in (record.depth_errors for record in records)]
    scaled = np.concatenate([ratio / np.median(ratio) for ratio in ratios if len(ratio)] or [np.empty(0)])
    return float(100.0 * (np.abs(scaled - 1.0) < _WITHIN).mean()) if len(scaled) else float("nan")


def relative_pose_aucs(record: Record) -> list[float]:
    """AUC of the relative poses of all pairs of frames, at 1, 5 and 20 degrees."""
    a = record.arrays
    errors = relative_pose_errors(a["rotations"], a["centers"], a["true_rotations"], a["true_centers"])
    return [auc(errors, threshold) for threshold in RELATIVE_POSE_THRESHOLDS]
