"""Comparisons of the default, shot by shot: with its own variants and with COLMAP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.markdown import table
from benchmarks.plan import COLMAP, EDGE, undrawn
from benchmarks.scores import Records, parallax_of, pose_aucs
from benchmarks.store import Record

POSE = ("ATE 0.2 cm", "ATE 2 cm", "T-RPE 0.1 cm", "T-RPE 0.5 cm", "R-RPE 0.02°", "R-RPE 0.1°")
_BEHIND = -3.0  # points of AUC, below which the default counts as behind


def _others(shot: str, variant: str, prior: str) -> list[tuple[str, str, str, str]]:
    """The cells with which `default` is compared: shot, variant, method and prior."""
    return [(shot, variant, "geometry", "none"), (shot, variant, "paper", prior)]


def no_harm(experiments: Mapping[str, Records]) -> list[str]:
    """`default` against the better of `geometry` and `paper`, column by column."""
    rows: list[list[Any]] = []
    for name, records in experiments.items():
        found = {(r.cell.shot, r.cell.variant, r.cell.method, r.cell.prior): r for r in records}
        for (shot, variant, method, prior), record in found.items():
            rivals = [pose_aucs([found[key]]) for key in _others(shot, variant, prior) if key in found]
            if method == "default" and name not in ("edge", "luck") and rivals:
                differences = np.array(pose_aucs([record])) - np.max(rivals, axis=0)
                rows.append([name, shot, variant, prior, *(f"{d:+.1f}" for d in differences), float(differences.min())])
    if not rows:
        return []
    rows.sort(key=lambda row: row[-1])
    behind = sum(row[-1] < _BEHIND for row in rows)
    header = ["experiment", "shot", "variant", "prior", *POSE, "worst"]
    return [
        "## Default against the better of geometry and paper",
        f"Points of AUC, shot by shot, worst first. More than 3 points behind in a column: {behind} of {len(rows)}.",
        table(header, rows),
    ]


def luck(experiments: Mapping[str, Records]) -> list[str]:
    """The same for the means of footage that was measured several times, with faint noise of different seeds."""
    draws: dict[tuple[str, str, str, str], dict[int, list[float]]] = {}
    for record in (record for records in experiments.values() for record in records):
        variant, draw = undrawn(record.cell.variant)
        key = record.cell.shot, variant, record.cell.method, record.cell.prior
        draws.setdefault(key, {})[draw] = pose_aucs([record])
    rows: list[list[Any]] = []
    for (shot, variant, method, prior), found in draws.items():
        others = (draws.get(key, {}) for key in _others(shot, variant, prior))
        rivals = [np.array(list(other.values())) for other in others if len(other) > 1]
        if method == "default" and len(found) > 1 and rivals:
            ours = np.array(list(found.values()))
            differences = ours.mean(0) - np.max([rival.mean(0) for rival in rivals], axis=0)
            spread = float(np.max([each.std(0, ddof=1) for each in (ours, *rivals)]))
            cells = [f"{d:+.1f}" for d in differences]
            rows.append([shot, variant, prior, len(found), *cells, spread, float(differences.min())])
    if not rows:
        return []
    rows.sort(key=lambda row: row[-1])
    behind = sum(row[-1] < _BEHIND for row in rows)
    header = ["shot", "variant", "prior", "draws", *POSE, "largest deviation of a draw", "worst"]
    return [
        "### How much of that is chance",
        "The same footage several times, each time with noise of half a grey level from another seed, so that other "
        "tracks survive: the mean of the default against the better of the means of geometry and paper, and the "
        "largest standard deviation of a single draw in a column. "
        f"More than 3 points behind in a column: {behind} of {len(rows)}.",
        table(header, rows),
    ]


def against_colmap(experiments: Mapping[str, Records]) -> list[str]:
    """`default` against the best of COLMAP's mappers on the same frames, by the median ATE."""
    rows: list[list[Any]] = []
    for name, records in experiments.items():
        colmap: dict[tuple[str, str], list[Record]] = {}
        for record in records:
            if record.cell.method in COLMAP and record.cell.shot not in EDGE:
                colmap.setdefault((record.cell.shot, record.cell.variant), []).append(record)
        for record in records:
            rivals = colmap.get((record.cell.shot, record.cell.variant))
            if record.cell.method == "default" and rivals:
                best = min(rivals, key=_median_ate)
                ours, theirs = _median_ate(record), _median_ate(best)
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
    both = np.isfinite(ratios)
    leads = int((ratios > 1).sum())
    text = (
        "Median ATE of the default and of the best of COLMAP's mappers, which is chosen with the truth, and the ratio "
        "of the latter to the former; the smallest ratios come first. The default leads in "
        f"{leads} of {len(rows)}, by a factor of {np.median(ratios[both]):.1f} in the median over the "
        f"{int(both.sum())} in which a mapper of COLMAP registers half of the frames."
    )
    header = ["experiment", "shot", "variant", "prior", "parallax", "default, mm", "best of COLMAP", "its mm", "ratio"]
    for row in rows:
        row[-1] = f"{row[-1]:.2f}" if np.isfinite(row[-1]) else "–"
    return ["## Default against the best of COLMAP", text, table(header, rows)]


def _median_ate(record: Record) -> float:
    """Median ATE, metres; infinite if half of the frames are not registered."""
    return float(np.median(record.errors.ate))


def _mm(meters: float) -> str:
    return f"{1e3 * meters:.2f}" if np.isfinite(meters) else "–"
