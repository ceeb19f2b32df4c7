"""Where the default leads and where it does not: against its own variants, and against COLMAP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.markdown import table
from benchmarks.plan import COLMAP, EDGE
from benchmarks.scores import Records, parallax_of, pose_aucs
from benchmarks.store import Record

POSE = ("ATE 0.2 cm", "ATE 2 cm", "T-RPE 0.1 cm", "T-RPE 0.5 cm", "R-RPE 0.02°", "R-RPE 0.1°")


def no_harm(experiments: Mapping[str, Records]) -> list[str]:
    """`default` against the better of `geometry` and `paper`, column by column."""
    rows: list[list[Any]] = []
    for name, records in experiments.items():
        found = {(r.cell.shot, r.cell.variant, r.cell.method, r.cell.prior): r for r in records}
        for (shot, variant, method, prior), record in found.items():
            others = [(shot, variant, "geometry", "none"), (shot, variant, "paper", prior)]
            rivals = [pose_aucs([found[key]]) for key in others if key in found]
            if method == "default" and name != "edge" and rivals:
                differences = np.array(pose_aucs([record])) - np.max(rivals, axis=0)
                rows.append([name, shot, variant, prior, *(f"{d:+.1f}" for d in differences), float(differences.min())])
    if not rows:
        return []
    rows.sort(key=lambda row: row[-1])
    behind = sum(row[-1] < -3.0 for row in rows)
    header = ["experiment", "shot", "variant", "prior", *POSE, "worst"]
    return [
        "## Default against the better of geometry and paper",
        f"Points of AUC, shot by shot, worst first. More than 3 points behind in a column: {behind} of {len(rows)}.",
        table(header, rows),
    ]


def against_colmap(experiments: Mapping[str, Records]) -> list[str]:
    """`default` against the best of COLMAP's mappers on the same frames, by the median error of the position."""
    rows: list[list[Any]] = []
    for name, records in experiments.items():
        colmap: dict[tuple[str, str], list[Record]] = {}
        for record in records:
            if record.cell.method in COLMAP and record.cell.shot not in EDGE:
                colmap.setdefault((record.cell.shot, record.cell.variant), []).append(record)
        for record in records:
            rivals = colmap.get((record.cell.shot, record.cell.variant))
            if record.cell.method == "default" and rivals:
                best = min(rivals, key=_typical)
                ours, theirs = _typical(record), _typical(best)
                rows.append(
                    [
                        *(name, record.cell.shot, record.cell.variant, record.cell.prior),
                        *(f"{value:.3f}" if (value := parallax_of(record)) else "–", _mm(ours)),
                        *(best.cell.method if np.isfinite(theirs) else "none registers half", _mm(theirs)),
                        theirs / ours if np.isfinite(theirs) else np.inf,
                    ]
                )
    if not rows:
        return []
    rows.sort(key=lambda row: row[-1])
    ratios = np.array([row[-1] for row in rows])
    beaten = np.isfinite(ratios)
    leads, tellable = int((ratios > 1).sum()), int(beaten.sum())
    text = (
        "Median ATE, shot by shot, and how many times as large that of the best of COLMAP's mappers is, chosen "
        f"knowing the truth; where the default is behind comes first. It leads in {leads} of {len(rows)}, by a factor "
        f"of {np.median(ratios[beaten]):.1f} in the median of the {tellable} in which one of them registers half of "
        "the frames."
    )
    header = ["experiment", "shot", "variant", "prior", "parallax", "default, mm", "best of COLMAP", "its mm", "ratio"]
    for row in rows:
        row[-1] = f"{row[-1]:.2f}" if np.isfinite(row[-1]) else "–"
    return ["## Default against the best of COLMAP", text, table(header, rows)]


def _typical(record: Record) -> float:
    """Median ATE, metres; infinite where half of the frames are missing."""
    return float(np.median(record.errors.ate))


def _mm(meters: float) -> str:
    return f"{1e3 * meters:.2f}" if np.isfinite(meters) else "–"
