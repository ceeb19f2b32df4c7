"""Scale and shift between the inverse depth of a scene and the depth prior of one image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.semidefinite import solution

Array = NDArray[np.float64]

# Standard deviations of the affine of an image in a joint solve.
SCALE_SIGMA = 0.5  # of the scale, relative
SHIFT_SIGMA = 0.3  # of the shift around 0, in units of the median inverse depth of the image
KNOWN_SHIFT_SIGMA = 0.02  # the same where the prior is depth, so that the shift is 0 but for errors

_FIT_SHIFT_SIGMA = 0.5  # as `SHIFT_SIGMA`, in `fit_affine`
_KERNEL = 2.0  # scale of the Cauchy kernel in standard deviations
_ITERATIONS = 8
_LEAST_SCALE = 0.05  # of the ratio of the medians


def fit_affine(inverse_depth: Array, measured: Array, *, free_shift: bool = True) -> tuple[float, float, float]:
    """Robust fit of ``scale * inverse_depth + shift ~ measured``.

    Iteratively re-weighted least squares with a Cauchy kernel. The scale stays positive, because a prior that gets
    smaller towards the camera is wrong.

    Args:
        inverse_depth: (n,) of the scene.
        measured: (n,) inverse depth of the prior.
        free_shift: whether the inverse depth of the prior is known up to a shift only.

    Returns:
        Scale, shift, and the robust standard deviation of the residuals in units of `measured`.
    """
    design = np.stack([inverse_depth, np.ones_like(inverse_depth)], -1)
    center = max(float(np.median(inverse_depth)), 1e-9)
    typical = float(np.median(measured))
    # A weak prior (shift 0, scale from the medians) determines what a small spread of the depths leaves open.
    first = np.array([typical / center, 0.0])
    shift_sigma = (_FIT_SHIFT_SIGMA if free_shift else KNOWN_SHIFT_SIGMA) * max(typical, 1e-9)
    prior = np.diag([first[0] ** -2.0, shift_sigma**-2.0])
    found = first
    sigma = 1.0
    for _ in range(_ITERATIONS):
        residual = design @ found - measured
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (_KERNEL * sigma)) ** 2)
        normal = design.T @ (design * weight[:, None]) / sigma**2
        found = solution(normal + prior, design.T @ (weight * measured) / sigma**2 + prior @ first)
    if found[0] < _LEAST_SCALE * first[0]:
        found = np.array([_LEAST_SCALE * first[0], typical - _LEAST_SCALE * typical])
    return float(found[0]), float(found[1]), sigma
