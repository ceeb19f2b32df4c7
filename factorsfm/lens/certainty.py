"""How certain a lens is: covariances from residuals that may be alike, and from leaving out parts of the shot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import image_cells
from factorsfm.adjustment.observations import DISTORTION
from factorsfm.adjustment.semidefinite import squared_deviations
from factorsfm.adjustment.state import LENS_SIZE

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CELLS = (6, 4)  # across and down, in which the errors of tracks may be alike
_LEFT_OUT = (3, 2, 3)  # parts across, down and in time, of which one at a time is left out


def lens_deviations(
    adjustment: BundleAdjustment, guess: Array | None = None, part: slice = DISTORTION
) -> tuple[Array, Array, float]:
    """(g + 6,) of log focal lengths and shape, NaN where held; and the evidence that a part of the shape is no guess.

    First from the residuals, of whose covariances the most doubtful one counts, then from what parts of the shot say.
    """
    groups = len(adjustment.state.log_focal)
    covariances = [*lens_covariances(adjustment), _left_out_covariance(adjustment)]
    std = np.full((len(covariances), groups + LENS_SIZE), np.nan)
    std[:, adjustment.free_optics] = np.sqrt([c.diagonal() for c in covariances])
    evidence = 0.0
    if guess is not None:
        free = np.isin(adjustment.free_optics, groups + np.arange(LENS_SIZE)[part])
        away = (adjustment.state.lens - guess)[adjustment.free_optics[free] - groups]
        evidence = min(squared_deviations(away, c[np.ix_(free, free)]) for c in covariances)
    return std[:-1].max(0), std[-1], evidence


def lens_covariances(adjustment: BundleAdjustment) -> list[Array]:
    """Covariance of the free ones of log focal lengths and shape, seen in several ways.

    Errors that are alike for a while, or in a part of the image, or as long as a track lives, count as one. How many
    there are is seen in blocks of residuals, and in how differently the parts of the image, and the tracks, pull.
    """
    columns = adjustment.columns.optics.start + adjustment.free_optics
    whole = adjustment.marginals().camera
    inflation = adjustment.error_inflation()
    o, influence = adjustment.observations, adjustment.influences(columns)
    xy = adjustment.state.normalized(o)
    mean = np.stack([np.bincount(o.point, xy[:, i]) for i in range(2)], -1) / np.bincount(o.point)[:, None]
    parts = image_cells(mean, *_CELLS), np.arange(len(mean))
    return [whole[np.ix_(columns, columns)] * inflation, *(_pulled_covariance(influence, part) for part in parts)]


def _pulled_covariance(influence: Array, part: Index) -> Array:
    """Covariance from how differently groups of points pull; `part`: (n,) group of each point."""
    used, key = np.unique(part, return_inverse=True)
    pull = np.stack([np.bincount(key, column) for column in influence.T], -1)
    return np.asarray(pull.T @ pull * (len(used) / max(len(used) - 1, 1)))


def _left_out_covariance(adjustment: BundleAdjustment) -> Array:
    """Covariance as in `lens_covariances`, from where the solution goes without each part of the shot: a jackknife.

    A part that says much of the cameras draws them to itself, and its residuals hide how wrong it is; left out, it
    cannot.
    """
    o = adjustment.observations
    across, down, stretches = _LEFT_OUT
    time = o.frame * stretches // (int(o.frame.max()) + 1)
    part = time * across * down + image_cells(adjustment.state.normalized(o), across, down)
    steps = np.array([adjustment.of(part != left_out).lens_step() for left_out in np.unique(part)])
    steps -= steps.mean(0)
    return np.asarray(steps.T @ steps * ((len(steps) - 1) / len(steps)))
