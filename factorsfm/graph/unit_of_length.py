"""The unit of length that factors of the caller's determine: an image sequence alone leaves it open."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors, MapValues, present_values
from factorsfm.graph.keys import letter_of
from factorsfm.graph.linear_system import LinearSystem
from factorsfm.support.semidefinite import covariance_of

Array = NDArray[np.float64]

_LARGEST_STD = 0.3  # of the logarithm of the unit, with which factors are taken to determine it
_STEPS, _TOLERANCE = 25, 1e-5


def unit_of_length(added: AddedFactors, contents: MapValues) -> tuple[float, float]:
    """By what lengths must be multiplied to fit the factors, and the standard deviation of its logarithm.

    Poses and landmarks are scaled as a whole, about the origin; the caller's own variables follow. The standard
    deviation is larger by as much as the factors fit worse than their noise says: those that are in another world, or
    contradict each other, determine no unit. 1 and infinity where the factors say nothing of lengths.

    Args:
        contents: of the map.
    """
    named = added.named
    present = present_values(named, contents)
    if present.size() < len(named):
        return 1.0, np.inf
    graph, own, unit, std = added.graph(), added.values(), 1.0, np.inf
    for _ in range(_STEPS):
        values = _scaled(present, unit)
        values.insert(own)
        keys = sorted(own.keys())
        system = LinearSystem.of(graph, values, keys)
        end = system.columns[keys[-1]].stop if keys else 0
        by_unit = system.derivative @ _by_unit(values, system)
        design = np.column_stack([system.derivative[:, :end], by_unit])
        information = design.T @ design
        if not by_unit.any() or np.linalg.cond(information) > 1e16:
            return 1.0, np.inf
        inverse = covariance_of(information)
        step = inverse @ (design.T @ system.residual)
        std = float(np.sqrt(inverse[-1, -1]))
        unit *= max(0.1, 1.0 + step[-1])
        own = own.retract(_as_vectors(step, system, keys))
        if abs(step[-1]) < _TOLERANCE:
            break
    std *= _misfit(system.residual - design @ step, design.shape[1])
    return (unit, std) if std < _LARGEST_STD else (1.0, np.inf)


def _misfit(residual: Array, unknowns: int) -> float:
    """By what the residuals, in standard deviations, are larger than they should be; at least 1."""
    return max(1.0, float(np.linalg.norm(residual) / np.sqrt(max(1, len(residual) - unknowns))))


def _scaled(present: gtsam.Values, unit: float) -> gtsam.Values:
    scaled = gtsam.Values()
    for key in list(present.keys()):
        letter = letter_of(key)
        if letter == "x":
            pose = present.atPose3(key)
            scaled.insert(key, gtsam.Pose3(pose.rotation(), unit * pose.translation()))
        elif letter == "l":
            scaled.insert(key, unit * present.atPoint3(key))
        else:
            affine = present.atCal3_S2(key)
            scaled.insert(key, gtsam.Cal3_S2(unit * affine.fx(), affine.fy(), 0.0, affine.px(), affine.py()))
    return scaled


def _by_unit(values: gtsam.Values, system: LinearSystem) -> Array:
    """Change of all variables by the logarithm of the unit."""
    direction = np.zeros(system.derivative.shape[1])
    for key, columns in system.columns.items():
        letter = letter_of(key)
        if letter == "x":
            pose = values.atPose3(key)
            direction[columns][3:] = pose.rotation().matrix().T @ pose.translation()
        elif letter == "l":
            direction[columns] = values.atPoint3(key)
        elif letter == "a":
            direction[columns][0] = values.atCal3_S2(key).fx()
    return direction


def _as_vectors(step: Array, system: LinearSystem, keys: Sequence[int]) -> gtsam.VectorValues:
    vectors = gtsam.VectorValues()
    for key in keys:
        vectors.insert(key, step[system.columns[key]])
    return vectors
