"""The error model of a depth prior, measured on the shot itself.

The errors of a network are smooth over the image and correlated from frame to frame, so that hundreds of keypoints on
ten keyframes are a handful of independent measurements. The error of the prior is modelled as

    ``d = a (1 / z + e(direction) + n) + b``,

with a smooth field ``e`` that belongs to the scene (shared by all images, exponential correlation over the viewing
direction) and independent noise ``n`` of each point. Their sizes are the most probable ones given the differences
between prior and geometry, the joint covariance of the geometry, and the usual sizes for networks. Where the geometry
is precise, the differences show the network's error; where it is not, its covariance explains them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.semidefinite import covariance_of, root_of, triangular_solution

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_SMOOTH = np.geomspace(0.05, 2.0, 9)  # candidate standard deviations, in units of the median inverse depth
_LOCAL = np.geomspace(0.05, 0.8, 7)
# Usual sizes for networks: means and spread (a factor) of log-normal priors.
_USUAL_SMOOTH, _USUAL_LOCAL, _USUAL_FACTOR = 0.4, 0.15, 2.0
_LENGTHS = (0.15, 0.5)  # candidate correlation lengths, in units of the extent of the scene's directions
_SAMPLE = 200  # points on which the likelihood is evaluated
_NODES = (8, 5)  # nodes of the field across and down


@dataclass(frozen=True, slots=True)
class PriorWeight:
    """Error model of the prior of one shot, in units of the scene's median inverse depth.

    Attributes:
        smooth: standard deviation of the smooth field.
        local: standard deviation of the independent noise of a point.
        length: correlation length of the field, radians.
        correlation: of the prior with the reconstructed inverse depth, after scale and shift.
    """

    smooth: float
    local: float
    length: float
    correlation: float


def direction_angles(bearing: Array) -> Array:
    """(n, 2) azimuth and elevation of unit vectors (radians)."""
    return np.stack([np.arctan2(bearing[:, 0], bearing[:, 2]), np.arcsin(np.clip(bearing[:, 1], -1.0, 1.0))], -1)


def sample_points(count: int) -> Index:
    """Rows of the points on which a weight is measured."""
    return np.sort(np.random.default_rng(0).permutation(count)[:_SAMPLE])


def measure_weight(angles: Array, inverse_depth: Array, prior: Array, covariance: Array) -> PriorWeight:
    """Most probable error model given the points of a shot.

    Args:
        angles: (n, 2) directions; inverse_depth: (n,) from geometry, median about 1.
        prior: (n,) inverse depth that the prior says, after scale and shift, averaged over the images.
        covariance: (n, n) of `inverse_depth`.
    """
    difference = prior - inverse_depth
    difference = difference - np.median(difference)
    spread = max(1.4826 * float(np.median(np.abs(difference))), 1e-6)
    difference = np.clip(difference, -4.0 * spread, 4.0 * spread)
    distance = np.linalg.norm(angles[:, None] - angles[None], axis=2)
    extent = float(np.ptp(angles, axis=0).max())
    # Scale and shift of the prior are free: directions of the data space that carry no information.
    free = np.stack([inverse_depth - np.mean(inverse_depth), np.ones_like(inverse_depth)], -1)
    nuisance = 4.0 * free @ free.T
    best, best_score = (float(_SMOOTH[-1]), float(_LOCAL[-1]), _LENGTHS[0] * extent), -np.inf
    for share in _LENGTHS:
        kernel = np.exp(-distance / (share * extent))
        for smooth, local in product(_SMOOTH, _LOCAL):
            total = covariance + nuisance + smooth**2 * kernel
            total[np.diag_indices_from(total)] += local**2
            root = root_of(total)
            white = triangular_solution(root, difference)
            score = -0.5 * float(white @ white) - float(np.log(root.diagonal()).sum())
            usual = np.log([smooth / _USUAL_SMOOTH, local / _USUAL_LOCAL]) / np.log(_USUAL_FACTOR)
            score -= 0.5 * float(usual @ usual)
            if score > best_score:
                best, best_score = (float(smooth), float(local), share * extent), score
    certain = covariance.diagonal() < np.median(covariance.diagonal()) * 4.0
    flat = certain.sum() < 3 or min(np.ptp(prior[certain]), np.ptp(inverse_depth[certain])) < 1e-6
    correlation = 0.0 if flat else float(np.corrcoef(prior[certain], inverse_depth[certain])[0, 1])
    return PriorWeight(*best, correlation)


def field_grid(angles: Array, weight: PriorWeight) -> tuple[Index, Array, Array, Array]:
    """Nodes of the smooth field under a set of directions.

    Returns:
        Node indices (n, 4), bilinear weights (n, 4), the information matrix of the nodes, and (n,) the standard
        deviation of what is left to a point: its local error, and what the field does between its nodes.
    """
    columns, rows = _NODES
    low, high = angles.min(0), angles.max(0)
    step = np.maximum(high - low, 1e-6) / [columns - 1, rows - 1]
    position = (angles - low) / step
    cell = np.minimum(position.astype(np.int64), [columns - 2, rows - 2])
    x, y = (position - cell).T
    corner = cell[:, 1] * columns + cell[:, 0]
    nodes = corner[:, None] + np.array([0, 1, columns, columns + 1])
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) * step
    distance = np.linalg.norm(grid[:, None] - grid[None], axis=2)
    covariance = weight.smooth**2 * (np.exp(-distance / weight.length) + 1e-6 * np.eye(len(grid)))
    to_node = weight.smooth**2 * np.exp(-np.linalg.norm(grid[nodes] + low - angles[:, None], axis=2) / weight.length)
    among = covariance[nodes[:, :, None], nodes[:, None, :]]
    between = weight.smooth**2 - 2.0 * (weights * to_node).sum(1) + np.einsum("ni,nij,nj->n", weights, among, weights)
    rest = np.sqrt(weight.local**2 + np.maximum(between, 0.0))
    return nodes, weights, covariance_of(covariance), rest
