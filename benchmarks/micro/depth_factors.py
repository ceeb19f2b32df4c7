"""Cost of a depth residual in GTSAM, for three kinds of factors."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.micro.timing import DEPTH_SIGMA, KERNEL, seconds
from factorsfm.graph.factors import (
    depth_consistency_factor,
    image_depth_factor,
    native_affine,
    native_affine_noise,
    native_depth_factor,
    virtual_offset,
)

Array = NDArray[np.float64]

_IMAGE_RESIDUALS = 100  # depth residuals of one image


def depth_factors() -> str:
    """Table of the cost of a depth residual in a Gauss-Newton step, by the number of variables in the graph."""
    rows: list[list[object]] = []
    for variables in (200, 1000, 5000, 20000):
        without = seconds(_depth_step(variables))
        row: list[object] = [variables]
        # Enough factors of each kind that their cost can be measured beside that of the step.
        for add, factors, residuals in (
            (_add_native, 20_000, 20_000),
            (_add_custom, 20, 20),
            (_add_whole_image, 20, 20 * _IMAGE_RESIDUALS),
        ):
            row.append(f"{1e6 * (seconds(_depth_step(variables, add, factors)) - without) / residuals:.1f}")
        rows.append(row)
    header = ["variables", "native factor", "one `CustomFactor` each", "whole-image `CustomFactor`, points fixed"]
    return (
        "Microseconds per residual in one Gauss-Newton step, beyond the cost of the step without them "
        f"({_IMAGE_RESIDUALS} residuals in a whole-image factor).\n\n{table(header, rows)}"
    )


def _depth_step(
    variables: int, add: Callable[[gtsam.NonlinearFactorGraph, Array, int], None] | None = None, factors: int = 0
) -> Callable[[], object]:
    """A Gauss-Newton step over landmarks with priors and the depth factors of one image."""
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 8), (variables, 3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, point in enumerate(points):
        values.insert(L(i), point)
        graph.add(gtsam.PriorFactorPoint3(L(i), point, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    for key, pose in ((X(0), gtsam.Pose3()), (T(0), virtual_offset())):
        values.insert(key, pose)
        graph.add(gtsam.PriorFactorPose3(key, pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-8)))
    native, affine = native_affine(1.0, 0.0), np.array([1.0, 0.0])
    values.insert(A(0), native)
    graph.add(gtsam.PriorFactorCal3_S2(A(0), native, native_affine_noise(0.5, 0.1)))
    values.insert(A(1), affine)
    graph.add(gtsam.PriorFactorVector(A(1), affine, gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    if add is not None:
        add(graph, points, factors)
    return lambda: gtsam.GaussNewtonOptimizer(graph, values).iterate()


def _add_native(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([DEPTH_SIGMA, 1e6]))
    for i in range(factors):
        row = i % _IMAGE_RESIDUALS
        graph.add(native_depth_factor(X(0), T(0), L(row), A(0), 1.0 / points[row, 2], noise))


def _add_custom(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, DEPTH_SIGMA)
    for i in range(factors):
        graph.add(depth_consistency_factor(X(0), L(i), A(1), 1.0 / points[i, 2], noise))


def _add_whole_image(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    seen, sigma = points[:_IMAGE_RESIDUALS], np.full(_IMAGE_RESIDUALS, DEPTH_SIGMA)
    for _ in range(factors):
        graph.add(image_depth_factor(X(0), A(1), seen, 1.0 / seen[:, 2], sigma, KERNEL, domain="inverse"))
