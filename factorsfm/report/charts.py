"""The charts of the report: one number per frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorsfm.result.reconstruction import FrameResult

_Item = TypeVar("_Item")


@dataclass(frozen=True, slots=True)
class Chart:
    """One value per frame, NaN if unknown.

    Attributes:
        std: standard deviations, drawn as a band; pale: a second line, drawn behind; both may be empty.
        from_zero: whether the axis starts at 0.
    """

    title: str
    values: NDArray[np.float64]
    std: NDArray[np.float64]
    pale: NDArray[np.float64]
    from_zero: bool

    def to_data(self) -> dict[str, Any]:
        return {
            "title": self.title,
            "values": short(self.values),
            "std": short(self.std),
            "pale": short(self.pale),
            "zero": self.from_zero,
        }


def charts(frames: Sequence[FrameResult], prior_residual: NDArray[np.float64], unit: str) -> list[Chart]:
    """All charts with at least one known number that is not 0.

    Args:
        prior_residual: (frames,) median magnitude of the relative residual.
        unit: of lengths.
    """
    fits = [frame.prior for frame in frames]
    carriers = [frame.observability for frame in frames]
    solved_inliers = [frame.inliers if frame.registered else np.nan for frame in frames]
    found = [
        _chart("Reprojection error, median (px)", (frame.reprojection_error for frame in frames)),
        _chart("Inliers; pale: tracked points", solved_inliers, pale=(frame.observations for frame in frames)),
        _chart("Pixel slide of a locked object, 1σ (px)", _read(carriers, lambda c: c.pixel_slide)),
        _chart(
            "Position known from the depth prior (%); pale: along the view axis",
            _read(carriers, lambda c: 100 * c.prior_share),
            pale=_read(carriers, lambda c: 100 * c.prior_share_view_axis),
        ),
        _chart("Triangulation angle, median (°)", _read(carriers, lambda c: c.triangulation_angle_deg)),
        _chart(f"Standard deviation of the position ({unit})", (_std(frame, slice(3, 6)) for frame in frames)),
        _chart("Standard deviation of the rotation (°)", (np.degrees(_std(frame, slice(0, 3))) for frame in frames)),
        _chart("Residual of the depth prior, median (%)", 100 * prior_residual),
        _chart("Scale of the depth prior, ±1σ", _read(fits, lambda p: p.scale), std=_read(fits, lambda p: p.scale_std)),
        _chart("Shift of the depth prior, ±1σ", _read(fits, lambda p: p.shift), std=_read(fits, lambda p: p.shift_std)),
    ]
    return [chart for chart in found if np.nan_to_num(chart.values).any() or np.nan_to_num(chart.pale).any()]


def short(values: Iterable[float]) -> list[float]:
    """Numbers with five significant digits, enough for a drawing."""
    return [float(f"{value:.5g}") for value in values]


def _chart(title: str, values: Iterable[float], *, std: Iterable[float] = (), pale: Iterable[float] = ()) -> Chart:
    first, band, second = (np.array(list(numbers), np.float64) for numbers in (values, std, pale))
    return Chart(title, first, band, second, from_zero=not len(band))


def _read(items: Sequence[_Item | None], number: Callable[[_Item], float]) -> list[float]:
    """A number of each item, NaN for None."""
    return [np.nan if item is None else number(item) for item in items]


def _std(frame: FrameResult, part: slice) -> float:
    """Root of the summed variances of the rotation vector or of the translation."""
    if frame.covariance is None:
        return float("nan")
    return float(np.sqrt(np.trace(frame.covariance[part, part])))
