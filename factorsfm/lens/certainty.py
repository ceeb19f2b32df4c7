"""Covariances of a lens: from residuals that may be correlated, and from leaving out parts of the shot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import image_cells
from factorsfm.adjustment.observations import DISTORTION
from factorsfm.adjustment.state import LENS_SIZE
from factorsfm.support.semidefinite import deviations, squared_deviations

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CELLS = (6, 4)  # across and down, in which the errors of tracks may be correlated
_LEFT_OUT = (3, 2, 3)  # parts across, down and in time; one at a time is left out


def lens_deviations(
    adjustment: BundleAdjustment, guess: Array | None = None, part: slice = DISTORTION
) -> tuple[Array, Array, float]:
    """Standard deviations of log focal lengths and shape, and the evidence that a part of the shape is no guess.

    Args:
        guess: (6,) shape; None asks for no evidence.

    Returns:
        (g + 6,) from the residuals, the largest of the covariances, NaN for what is constant; (g + 6,) from leaving out
        parts of the shot; and squared standard deviations.
    """
    groups = len(adjustment.state.log_focal)
    covariances = [*lens_covariances(adjustment), _left_out_covariance(adjustment)]
    std = np.full((len(covariances), groups + LENS_SIZE), np.nan)
    std[:, adjustment.free_optics] = [deviations(c) for c in covariances]
    evidence = 0.0
    if guess is not None:
        free = np.isin(adjustment.free_optics, groups + np.arange(LENS_SIZE)[part])
        away = (adjustment.state.lens - guess)[adjustment.free_optics[free] - groups]
        evidence = min(squared_deviations(away, c[np.ix_(free, free)]) for c in covariances)
    return std[:-1].max(0), std[-1], evidence


def lens_covariances(adjustment: BundleAdjustment) -> list[Array]:
    """Covariances of the free ones of log focal lengths and shape, each for another correlation of the errors.

    Errors may be correlated for a while, in a part of the image, or along a track. The first covariance is inflated by
    the correlation within blocks of residuals; the others follow from how differently parts of the image, and tracks,
    pull at the lens.
    """
    columns = adjustment.columns.optics.start + adjustment.free_optics
    marginals = adjustment.marginals()
    inflation = adjustment.error_inflation()
    o, influence = adjustment.observations, adjustment.influences(marginals, columns)
    xy = adjustment.state.normalized(o)
    mean = np.stack([np.bincount(o.point, xy[:, i]) for i in range(2)], -1) / np.bincount(o.point)[:, None]
    parts = image_cells(mean, *_CELLS), np.arange(len(mean))
    whole = marginals.camera[np.ix_(columns, columns)] * inflation
    return [whole, *(_pulled_covariance(influence, part) for part in parts)]


def _pulled_covariance(influence: Array, part: Index) -> Array:
    """Covariance from the sums of influences over groups of points; `part`: (n,) group of each point."""
    used, key = np.unique(part, return_inverse=True)
    pull = np.stack([np.bincount(key, column) for column in influence.T], -1)
    return np.asarray(pull.T @ pull * (len(used) / max(len(used) - 1, 1)))


def _left_out_covariance(adjustment: BundleAdjustment) -> Array:
    """Covariance as in `lens_covariances`, a jackknife: from the steps of the solution without each part of the shot.

    A part with much weight draws the cameras to itself, and its residuals hide its errors; left out, it cannot.
    """
    o = adjustment.observations
    across, down, stretches = _LEFT_OUT
    time = o.frame * stretches // (int(o.frame.max()) + 1)
    part = time * across * down + image_cells(adjustment.state.normalized(o), across, down)
    steps = adjustment.lens_steps_without(part)
    steps -= steps.mean(0)
    return np.asarray(steps.T @ steps * ((len(steps) - 1) / len(steps)))
