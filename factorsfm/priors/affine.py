"""Scale and shift of the depth prior of one image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KERNEL = 2.0  # Cauchy scale in standard deviations
SCALE_SIGMA = 0.5  # relative prior of the scale of an image's depth
SHIFT_SIGMA = 0.3  # prior of its shift around 0, in units of the image's median inverse depth
KNOWN_SHIFT_SIGMA = 0.02  # the same where the prior knows its zero (depth, metric depth)


def fit_affine(inverse_depth: Array, measured: Array, *, free_shift: bool = True) -> tuple[float, float, float]:
    """Robust scale and shift with ``scale * inverse_depth + shift ~ measured``, and the spread of the residuals.

    The scale is kept positive: a mirrored prior is no prior.
    """
    design = np.stack([inverse_depth, np.ones_like(inverse_depth)], -1)
    center = max(float(np.median(inverse_depth)), 1e-9)
    # A weak prior (shift 0, scale from the medians) settles what the spread of the depths leaves open.
    first = np.array([float(np.median(measured)) / center, 0.0])
    shift_sigma = (0.5 if free_shift else 0.02) * max(float(np.median(measured)), 1e-9)
    prior = np.diag([first[0] ** -2.0, shift_sigma**-2.0])
    solution = first
    weight = np.ones_like(measured)
    spread = 1.0
    for _ in range(8):
        residual = design @ solution - measured
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = 1.0 / (1.0 + (residual / (_KERNEL * spread)) ** 2)
        normal = design.T @ (design * weight[:, None]) / spread**2
        solution = np.linalg.solve(normal + prior, design.T @ (weight * measured) / spread**2 + prior @ first)
    if solution[0] < 0.05 * first[0]:
        solution = np.array([0.05 * first[0], float(np.median(measured)) - 0.05 * float(np.median(measured))])
    return float(solution[0]), float(solution[1]), spread
