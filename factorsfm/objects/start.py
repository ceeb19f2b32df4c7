"""Where the solution of an object starts: shape and motion in a few frames that share many tracks, from many starts.

Of a thing that is small in the image, perspective says little: a thing that turns one way and its mirror image in
depth that turns the other way look almost the same, and so do plates that turn and plates that slide. An adjustment
ends in whichever of them is near. So it starts from every way to turn, and the best fit of all counts. How much better
it is than the next one that turns otherwise says whether the images determine the motion at all.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX, coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.motion.moving import bounded_costs
from factorsfm.motion.readings import in_front
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import exponential
from factorsfm.tracks.image_tracks import ImageTracks, shared_tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

LEAST_TRACKS = 20  # of a frame; with fewer, a pose is hardly more than a guess
LEAST_FRAMES = 5  # that have so many
_FRAMES, _TRACKS, _LEAST_VIEWS = 10, 150, 3  # of the start: they decide which way the thing turns, no more
_LEAST_SEEN = 6  # of these tracks in each of these frames: a pose has six variables, and twice as many are seen
_TURNS_DEG = (20.0, 60.0)  # by which the thing turns in these frames; starts half as far away still arrive
_ROUGH, _FINE = 12, 60  # iterations
_CANDIDATES = 8  # that are converged
_WIDE_PX = 0.5  # noise that is assumed first: the kernel is then as wide as a wrong start needs
_DEVIATIONS = np.sqrt(12.0)  # standard deviations in the width of what is spread evenly
_OTHER_DEG = 8.0  # by which solutions differ that are not the same


@dataclass(frozen=True, slots=True)
class ObjectStart:
    """An object in a few frames; the first camera is its world, its distance about 1.

    Attributes:
        images: their tracks; ids: (n,) of the points of `state`.
        margin: by how much the logarithm of the probability of this solution is larger than that of the best one that
            turns otherwise; infinite if there is none.
        perspective: how much larger the near side of a thing as deep as it is wide is than the far side, pixels.
    """

    images: list[ImageTracks]
    ids: Index
    state: State
    margin: float
    perspective: float


def object_start(images: Sequence[ImageTracks], turns: Array, options: PolishOptions) -> ObjectStart | None:
    """The best start; None where no few frames have enough tracks in common.

    Args:
        images: that see the object; turns: (images, 3, 3) rotations cam_from_world of the scene, which an object that
            does not turn has, too.
    """
    chosen = _best_window(images)
    if chosen is None:
        return None
    few, turns = [images[row] for row in chosen], turns[chosen]
    ids = _longest(few)
    focal = np.array([image.camera.mean_focal_length() for image in few])
    observations = gather(few, ids, focal)
    if len(ids) < LEAST_TRACKS or np.bincount(observations.frame, minlength=len(few)).min() < _LEAST_SEEN:
        return None
    width = _width(observations, focal)
    options = replace(options, point_sigma=min(options.point_sigma, width))
    rough = [_solved(start, observations, options, _WIDE_PX, _ROUGH) for start in _starts(turns, observations, focal)]
    rough.sort(key=lambda solved: solved.cost())
    found = []
    for solved in rough[:_CANDIDATES]:
        wide = _solved(solved.state, observations, options, _WIDE_PX, _FINE)
        sigma = coordinate_sigma(wide.reprojection_errors())
        found.append(_solved(wide.state, observations, options, sigma, _FINE))
    sigma = max(SMALLEST_SIGMA_PX, min(coordinate_sigma(solved.reprojection_errors()) for solved in found))
    # Errors of neighbouring tracks repeat themselves, and count as many times less.
    inflation = min(solved.error_inflation() for solved in found)
    costs = [bounded_costs(solved, sigma).sum() / inflation + _shape_cost(solved.state, width) for solved in found]
    best = found[int(np.argmin(costs))]
    others = [cost for cost, solved in zip(costs, found, strict=True) if _turns_otherwise(solved.state, best.state)]
    margin = min(others, default=np.inf) - min(costs)
    logger.info("object: %d tracks in %d frames, %.3f px, margin %.1f", len(ids), len(few), sigma, margin)
    perspective = float(_DEVIATIONS**2 * width**2 * np.median(focal))
    return ObjectStart(few, ids, in_front(best.state), margin, perspective)


def _best_window(images: Sequence[ImageTracks]) -> Index | None:
    """Rows of some frames, evenly between the two that have the most tracks in common over the longest time."""
    best, ends = 0, None
    step = max(1, len(images) // 60)
    for first in range(0, len(images), step):
        for last in range(first + _LEAST_VIEWS - 1, len(images), step):
            common = shared_tracks(images[first], images[last])
            if common < LEAST_TRACKS:
                break
            if common * (last - first) > best:
                best, ends = common * (last - first), (first, last)
    if ends is None:
        return None
    return np.unique(np.linspace(*ends, _FRAMES).round().astype(np.int64))


def _longest(images: Sequence[ImageTracks]) -> Index:
    """Ids (ascending) of the tracks that most of the images see."""
    ids, count = np.unique(np.concatenate([image.ids for image in images]), return_counts=True)
    order = np.argsort(-count, kind="stable")[:_TRACKS]
    return np.sort(ids[order][count[order] >= _LEAST_VIEWS])


def _starts(turns: Array, observations: Observations, focal: Array) -> list[State]:
    """A flat thing at the distance 1 that follows its place in the image, not turning, or turning in 8 directions."""
    o, count = observations, len(turns)
    place = np.array([np.median(o.pixels[o.frame == row], 0) for row in range(count)]) / focal[:, None]
    middle = np.concatenate([place, np.ones((count, 1))], 1)
    rays = np.concatenate([o.pixels[o.first] / focal[o.frame[o.first], None], np.ones((len(o.first), 1))], 1)
    states = []
    for turn in _turns():
        rotation = turns @ turns[0].T @ exponential(np.linspace(0.0, 1.0, count)[:, None] * turn)
        translation = middle - rotation @ middle[0]
        points = np.einsum("nji,nj->ni", rotation[o.frame[o.first]], rays - translation[o.frame[o.first]])
        distance = np.linalg.norm(points, axis=1)
        states.append(State(rotation, translation, points / distance[:, None], 1.0 / distance, np.log(focal[:1])))
    if np.ptp(focal) > 0.0:
        group = np.arange(count)
        states = [replace(state, log_focal=np.log(focal), group=group) for state in states]
    return states


def _turns() -> list[Array]:
    """Rotation vectors: none, and about the axes of the image and between them."""
    angles = np.arange(8) * np.pi / 4
    axes = np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], 1)
    return [np.zeros(3)] + [np.radians(size) * axis for size in _TURNS_DEG for axis in axes]


def _solved(
    state: State, observations: Observations, options: PolishOptions, sigma: float, iterations: int
) -> BundleAdjustment:
    solved = BundleAdjustment(state, observations, replace(options, iterations=iterations), ErrorModel(sigma))
    solved.solve()
    return solved


def _width(observations: Observations, focal: Array) -> float:
    """Typical standard deviation of the places of the tracks in a frame, over the focal length."""
    o = observations
    spread = [np.sqrt(o.pixels[o.frame == row].var(0).mean()) for row in range(len(focal))]
    return float(np.median(np.array(spread) / focal))


def _shape_cost(state: State, width: float) -> float:
    """Of how deep a thing is: a thing is about as deep as it is wide, and a wrong solution often several times so."""
    relief = state.inverse_distance / np.median(state.inverse_distance) - 1.0
    return 0.5 * float(((relief / width) ** 2).sum())


def _turns_otherwise(state: State, other: State) -> bool:
    """Whether two solutions turn differently."""
    difference = np.einsum("kji,kjl->kil", state.rotation, other.rotation)
    cosine = 0.5 * (np.trace(difference, axis1=1, axis2=2).min() - 1.0)
    return bool(cosine < np.cos(np.radians(_OTHER_DEG)))
