"""Readings of a shot: which points belong to the scene, and the motion of the camera that explains them.

Takes points and cameras to start from, converges, and compares what several readings explain: each part of the image
counts the same, however many tracks it has.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.motion.at_rest import image_weights
from factorsfm.motion.moving import bounded_costs, largest_cost
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import exponential

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_POINT_ITERATIONS = 4  # of the points alone, until they show what fits the cameras of a start
_SETTLED = 0.8  # of the assumed noise, below which the measured noise asks for another round
_REFUTED = 0.5  # of the cost of points among all: what they cost by themselves, where something else moves by itself


@dataclass(frozen=True, slots=True)
class Reading:
    """Some points, and the cameras that explain them.

    Attributes:
        kept: which of all points it has; adjustment: converged over them.
    """

    kept: Index
    adjustment: BundleAdjustment


def most_likely(readings: Sequence[Reading], observations: Observations) -> tuple[int, float]:
    """The reading that costs least of those that refute the first one; and its cost over that of the next best scene.

    The first one may explain everything half: then it costs less than any that explains one of two things and leaves
    the other one out. It does not stand where each thing is explained far better by a reading of its own.

    Args:
        observations: of all points.

    Returns:
        Its place, 0 where none refutes the first one.
    """
    sigma = min(reading.adjustment.sigma for reading in readings)
    weights = image_weights(observations)
    table = np.array([_costs(reading, observations, sigma) for reading in readings])
    costs = np.average(table, axis=1, weights=weights)
    refuting = [k for k in range(1, len(readings)) if _refutes(readings[k], readings[0], observations)]
    if not refuting:
        return 0, 0.0
    best = min(refuting, key=lambda k: float(costs[k]))
    apart = float(np.average(table[refuting].min(axis=0), weights=weights))
    logger.info(
        "one scene alone costs %.2f of what all do, each thing apart %.2f", *(np.r_[costs[best], apart] / costs[0])
    )
    if costs[best] > costs[0] and apart > _REFUTED * costs[0]:
        return 0, 0.0
    others = [k for k in refuting if _another_scene(readings[k], readings[best])]
    return best, float(costs[best] / costs[others].min(initial=np.inf))


def _another_scene(reading: Reading, known: Reading) -> bool:
    """Whether most of the points of a reading are not those of another one."""
    return bool(np.isin(reading.kept, known.kept).mean() < 0.5)


def _refutes(reading: Reading, known: Reading, few: Observations) -> bool:
    """Whether a reading explains the points that it keeps far better than another reading does."""
    mine = np.isin(few.point, reading.kept)
    own, other = (_costs(s, few, reading.adjustment.sigma)[mine].sum() for s in (reading, known))
    return bool(own < _REFUTED * other)


def cost(reading: Reading, few: Observations, sigma: float) -> float:
    """Of a typical observation, each part of the image counting the same; as `_costs`."""
    return float(np.average(_costs(reading, few, sigma), weights=image_weights(few)))


def _costs(reading: Reading, few: Observations, sigma: float) -> Array:
    """Of all observations; those that a reading leaves out cost what one that stands out does.

    Args:
        sigma: as in `bounded_costs`.
    """
    costs = np.full(len(few.frame), largest_cost(reading.adjustment.options.kernel))
    costs[np.isin(few.point, reading.kept)] = bounded_costs(reading.adjustment, sigma)
    return costs


def solution_from(part: State, few: Observations, options: PolishOptions) -> BundleAdjustment:
    """Converged from one start: first with a wide kernel, then with one that fits the residuals."""
    errors = BundleAdjustment(part, few, options, ErrorModel(1.0)).reprojection_errors()
    sigma = max(FIRST_SIGMA_PX, coordinate_sigma(errors))
    adjustment = BundleAdjustment(part, few, replace(options, iterations=20, tolerance=1e-3), ErrorModel(sigma))
    adjustment.solve()
    iterations, measured = adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
    while True:
        # A wide kernel averages over outliers; the solution counts once the kernel fits the residuals.
        sigma = min(sigma, measured)
        adjustment = BundleAdjustment(adjustment.state, few, options, ErrorModel(sigma))
        adjustment.solve()
        iterations, measured = iterations + adjustment.iterations, coordinate_sigma(adjustment.reprojection_errors())
        if measured > _SETTLED * sigma:
            break
    logger.debug("cameras: %d iterations, %.3f px", iterations, measured)
    return BundleAdjustment(in_front(adjustment.state), few, options, ErrorModel(measured))


def points_alone(start: State, few: Observations, sigma: float, options: PolishOptions) -> BundleAdjustment:
    """The points of a start as its cameras see them; `sigma` of a coordinate, pixels."""
    solver = replace(options, iterations=_POINT_ITERATIONS)
    points = BundleAdjustment(start, few, solver, ErrorModel(sigma), free=Free(cameras=False))
    points.solve()
    return points


def flat(part: State, few: Observations, options: PolishOptions) -> State:
    """Rotations alone, all points at one distance: a start without any shape."""
    still = replace(
        part,
        translation=np.zeros_like(part.translation),
        inverse_distance=np.full(len(part.inverse_distance), float(np.median(part.inverse_distance))),
    )
    rotating = BundleAdjustment(
        still, few, replace(options, iterations=15), ErrorModel(1.0), free=Free(translation=False)
    )
    return rotating.solve()


def in_front(part: State) -> State:
    """The solution with its scene in front: negated inverse distances and translations show the same images."""
    if float(np.median(part.inverse_distance)) >= 0.0:
        return part
    return replace(part, translation=-part.translation, inverse_distance=-part.inverse_distance)


def reversed_scene(part: State) -> State:
    """Near and far exchanged and the motion reversed: in a narrow view the images are almost the same.

    Each camera also turns, by twice the angle under which its way is seen from the middle of the scene: what was seen
    there stays where it was. Without that, the way back to the first scene is shorter than that to its reversal.
    """
    center = float(np.median(part.inverse_distance))
    inverse = np.clip(2.0 * center - part.inverse_distance, 0.05 * center, 4.0 * center)
    x, y, z = 2.0 * center * part.translation.T
    turn = exponential(np.stack([-y, x, np.zeros_like(x)], 1) / np.maximum(1.0 + z, 0.5)[:, None])
    return replace(part, rotation=turn @ part.rotation, translation=-part.translation, inverse_distance=inverse)
