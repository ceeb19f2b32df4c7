"""Information matrices in which something may not be determined: solutions, roots and covariances all the same.

All systems of normal equations are solved here: none fails, whatever the images leave open. Matrices are symmetric,
(..., n, n); a stack of them is solved one by one where a single one of it needs that.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of a matrix with a unit diagonal: smaller eigenvalues are rounding errors of the elimination.
_LEAST_EIGENVALUE = 1e-12
_BLOCK = 96  # rows of a triangular matrix that are solved for at once, as if it were full
_NOTHING = 1e-100  # information; its inverse is still a number, and so is its square


def conditioned(information: Array) -> Array:
    """The matrix (n, n) with a ridge far below any information that matters."""
    return np.asarray(information + np.diag(_LEAST_EIGENVALUE * np.maximum(information.diagonal(), _NOTHING)))


def solution(information: Array, gradient: Array) -> Array:
    """``information^-1 gradient``, gradients as in `numpy.linalg.solve`; 0 along what is not determined."""
    try:
        return np.asarray(np.linalg.solve(information, gradient))
    except np.linalg.LinAlgError:
        return np.asarray(_by_spectrum(information, _pseudo_inverse) @ gradient)


def covariance_of(information: Array) -> Array:
    """``information^-1``; what is not determined has a very large variance, not a negative one."""
    try:
        root = np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return _by_spectrum(information, _large_inverse)
    if not np.isfinite(root).all():
        return _by_spectrum(information, _large_inverse)
    half = triangular_solution(
        np.asarray(root, np.float64), np.eye(information.shape[-1])
    )  # its square has no negative eigenvalues
    return np.asarray(half.swapaxes(-1, -2) @ half)


def root_of(matrix: Array) -> Array:
    """Lower triangular root of an information or a covariance; rounding errors do not make it fail.

    What is not determined is next to nothing in it.
    """
    try:
        return np.asarray(np.linalg.cholesky(matrix))
    except np.linalg.LinAlgError:
        return _by_spectrum(matrix, _triangular_root)


def covariance_and_root(information: Array) -> tuple[Array, Array]:
    """``information^-1`` as `covariance_of` gives it, and its lower triangular root."""
    try:
        covariance = np.asarray(np.linalg.inv(information))
        return covariance, np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        covariance = covariance_of(information)
        return covariance, root_of(covariance)


def triangular_solution(root: Array, values: Array) -> Array:
    """``root^-1 values`` of a lower triangular matrix without a zero on its diagonal, as `root_of` gives it."""
    size = root.shape[-1]
    if size <= _BLOCK or root.ndim > 2:
        return np.asarray(np.linalg.solve(root, values))
    found = np.empty(values.shape)
    for begin in range(0, size, _BLOCK):
        here = slice(begin, begin + _BLOCK)
        found[here] = np.linalg.solve(root[here, here], values[here] - root[here, :begin] @ found[:begin])
    return found


def deviations(covariance: Array) -> Array:
    """(..., n) standard deviations; a variance that rounding has made negative is 0."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("...ii->...i", covariance), 0.0)))


def squared_deviations(values: Array, covariance: Array) -> float:
    """``values covariance^-1 values``, of a covariance that may have been seen on too few samples to have full rank."""
    return float((triangular_solution(root_of(conditioned(covariance)), values) ** 2).sum())


# --- where something is not determined --------------------------------------------------------------------------


def _by_spectrum(matrix: Array, function: Callable[[Array, Array, Array], Array]) -> Array:
    """A function of the scale (n,) that makes the diagonal 1, and of eigenvalues and eigenvectors of what is scaled so.

    A variable without information keeps an eigenvalue of zero; one whose information is no number has none.
    """
    found = np.empty_like(matrix)
    for at in np.ndindex(matrix.shape[:-2]):
        known = np.where(np.isfinite(matrix[at]), matrix[at], 0.0)
        diagonal = known.diagonal()
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        found[at] = function(scale, *np.linalg.eigh(known * np.outer(scale, scale)))
    return found


def _pseudo_inverse(scale: Array, values: Array, vectors: Array) -> Array:
    inverse = np.where(values > _LEAST_EIGENVALUE, 1.0 / np.maximum(values, _LEAST_EIGENVALUE), 0.0)
    half = scale[:, None] * vectors
    return np.asarray(half * inverse @ half.T)


def _large_inverse(scale: Array, values: Array, vectors: Array) -> Array:
    half = scale[:, None] * vectors / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))
    return np.asarray(half @ half.T)


def _triangular_root(scale: Array, values: Array, vectors: Array) -> Array:
    half = vectors * np.sqrt(np.maximum(values, _LEAST_EIGENVALUE)) / scale[:, None]
    upper = np.asarray(np.linalg.qr(half.T, mode="r"))
    return np.asarray(np.where(upper.diagonal() < 0.0, -1.0, 1.0)[:, None] * upper).T
