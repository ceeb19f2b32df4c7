"""Figures of the results, as PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from benchmarks.scores import Label, Records, by_label, by_shot, parallax_of, pooled_errors
from factorsfm.evaluation.metrics import ATE_THRESHOLDS, R_RPE_THRESHOLDS, T_RPE_THRESHOLDS, DepthErrors, recall_curve

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

_DPI = 130
_COLORS = {
    "default": "#c1272d",
    "paper": "#e08a1e",
    "geometry": "#2e8b57",
    "colmap_tuned": "#1f4e9c",
    "colmap_default": "#7fa8d9",
    "colmap_global": "#7a4fa3",
}
_PRIOR_STYLE = {"simulated": "--"}
_MARKERS = {"simulated": "^", "none": "s"}
_UNITS = (
    ("ATE", "cm", 100.0, ATE_THRESHOLDS),
    ("T-RPE", "cm", 100.0, T_RPE_THRESHOLDS),
    ("R-RPE", "°", 1.0, R_RPE_THRESHOLDS),
)


def recall_curves(records: Records, path: Path) -> None:
    """Recall curves of ATE, T-RPE and R-RPE up to the paper's larger threshold, with its smaller one marked."""
    figure, panels = plt.subplots(1, 3, figsize=(12, 4.2), sharey=True)
    for label, members in by_label(records).items():
        for axes, errors, (_, _, unit, limits) in zip(panels, pooled_errors(members), _UNITS, strict=True):
            x = np.geomspace(0.01 * limits[1], limits[1], 500)
            axes.plot(unit * x, recall_curve(errors, x), **_line(label))
    for axes, (name, symbol, unit, limits) in zip(panels, _UNITS, strict=True):
        axes.axvline(unit * limits[0], color="0.6", lw=0.8, ls=":")
        axes.set(xlabel=f"{name} ({symbol})", xscale="log", ylim=(0, 101))
        axes.set_xlim(0.01 * unit * limits[1], unit * limits[1])
        _plain_numbers(axes.xaxis)
    panels[0].set_ylabel("frames within the error (%)")
    _finish(figure, panels[0], path)


def depth_recall(records: Records, path: Path) -> None:
    """Recall curve of the relative depth error of the points, up to 20 %."""
    figure, axes = plt.subplots(figsize=(8, 4.8))
    x = np.linspace(0.0, 0.2, 400)
    for label, members in by_label(records).items():
        relative = DepthErrors.pool(record.depth_errors for record in members).relative
        if len(relative):
            axes.plot(100 * x, recall_curve(relative, x), **_line(label))
    axes.axvline(5, color="0.6", lw=0.8, ls=":")
    axes.set(xlabel="relative depth error (%)", ylabel="points within the error (%)", xlim=(0, 20), ylim=(0, 101))
    _finish(figure, axes, path)


def error_against_parallax(records: Records, path: Path) -> None:
    """Median ATE against parallax, a dot per shot and method; at the top if half of the frames are not registered."""
    figure, axes = plt.subplots(figsize=(8, 5))
    known = [r for r in records if parallax_of(r) is not None]
    medians = {id(r): 1e3 * float(np.median(r.errors.ate)) for r in known}
    highest = max((m for m in medians.values() if np.isfinite(m)), default=1.0)
    missing = 3.0 * highest
    # Dots of one shot are side by side around its parallax, so that equal errors do not cover each other.
    labels = by_label(known)
    for offset, (label, members) in zip(np.linspace(-0.06, 0.06, len(labels)), labels.items(), strict=True):
        x = np.array([parallax_of(r) for r in members], np.float64) * np.exp(offset)
        y = np.array([medians[id(r)] for r in members])
        marker = _MARKERS.get(label.prior, "o")
        color = _COLORS.get(label.method, "0.4")
        axes.scatter(x, np.where(np.isfinite(y), y, missing), s=34, marker=marker, color=color, label=str(label), lw=0)
    values = [value for r in known if (value := parallax_of(r))]
    axes.axhline(missing / np.sqrt(3.0), color="0.6", lw=0.8, ls=":")
    axes.set(xscale="log", yscale="log", xlabel="parallax (camera path over median depth)", ylabel="median ATE (mm)")
    axes.set_xlim(0.6 * min(values), 1.7 * max(values))
    axes.set_ylim(top=2.0 * missing)
    _plain_numbers(axes.xaxis)
    _plain_numbers(axes.yaxis)
    axes.text(0.99, 1.4 * missing, "not registered", transform=axes.get_yaxis_transform(), ha="right", color="0.4")
    _finish(figure, axes, path)


def parallax_histogram(records: Records, path: Path) -> None:
    """Histogram of the parallax of the shots."""
    values = {shot: value for shot, members in by_shot(records).items() if (value := _full_parallax(members))}
    figure, axes = plt.subplots(figsize=(6.4, 3.6))
    axes.hist(list(values.values()), bins=np.geomspace(2e-3, 2.0, 16).tolist(), color="#1f4e9c", edgecolor="white")
    axes.set(xscale="log", xlabel="parallax (camera path over median depth)", ylabel="shots")
    _plain_numbers(axes.xaxis)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _finish(figure, None, path)


def _full_parallax(members: Records) -> float | None:
    """Parallax of a shot, from the record with the most frames."""
    return parallax_of(max(members, key=lambda record: len(record.arrays["indices"])))


def _line(label: Label) -> dict[str, Any]:
    style = _PRIOR_STYLE.get(label.prior, "-")
    width = 2.2 if label.method == "default" else 1.4
    return {"color": _COLORS.get(label.method, "0.4"), "ls": style, "lw": width, "label": str(label)}


def _plain_numbers(axis: Axis) -> None:
    """Label 1, 2 and 5 of every decade of a logarithmic axis, as 0.01 instead of a power of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _finish(figure: Figure, legend_of: Axes | None, path: Path) -> None:
    for axes in figure.axes:
        axes.grid(color="0.92", lw=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    if legend_of is not None:
        handles, labels = legend_of.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.set_layout_engine("constrained", wspace=0.06)
    figure.savefig(path, dpi=_DPI)
    plt.close(figure)
