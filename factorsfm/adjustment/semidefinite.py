"""Information matrices in which something may not be determined: solutions and covariances all the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of an information matrix with a unit diagonal: smaller eigenvalues are rounding errors of the elimination.
_LEAST_EIGENVALUE = 1e-12


def conditioned(information: Array) -> Array:
    """The matrix with a ridge far below any information that matters."""
    return np.asarray(information + np.diag(_LEAST_EIGENVALUE * np.maximum(information.diagonal(), 1e-300)))


def solution(information: Array, gradient: Array) -> Array:
    """``information^-1 gradient``; 0 along what is not determined."""
    try:
        return np.asarray(np.linalg.solve(information, gradient))
    except np.linalg.LinAlgError:
        scale, values, vectors = _spectrum(information)
        inverse = np.where(values > _LEAST_EIGENVALUE, 1.0 / np.maximum(values, _LEAST_EIGENVALUE), 0.0)
        return np.asarray(scale * (vectors @ (inverse * (vectors.T @ (scale * gradient)))))


def covariance_of(information: Array) -> Array:
    """``information^-1``; what is not determined has a very large variance, not a negative one."""
    try:
        np.linalg.cholesky(information)
        return np.asarray(np.linalg.inv(information))
    except np.linalg.LinAlgError:
        scale, values, vectors = _spectrum(information)
        half = scale[:, None] * vectors / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))
        return np.asarray(half @ half.T)


def squared_deviations(values: Array, covariance: Array) -> float:
    """``values covariance^-1 values``, of a covariance that may have been seen on too few samples to have full rank."""
    return float(values @ covariance_of(conditioned(covariance)) @ values)


def _spectrum(information: Array) -> tuple[Array, Array, Array]:
    """(n,) scale that makes the diagonal 1, eigenvalues and eigenvectors of what is scaled so; a zero stays zero."""
    diagonal = information.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    return scale, values, vectors
