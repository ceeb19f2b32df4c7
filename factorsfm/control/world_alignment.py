"""The world alignment: the similarity from the world of a free solution to that of its control, in closed form."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.rotations import nearest_rotation
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]

_MOST_SUBSETS = 300
_REWEIGHTINGS = 20
_DISTINCT = 3.0  # standard deviations by which positions must differ, and lie off a line, to determine anything


@dataclass(frozen=True, slots=True)
class Correspondences:
    """Positions, rotations and lengths that both worlds know.

    Attributes:
        source, target: (n, 3) positions in the world of the solution and in that of the control; sigma: (n,).
        source_rotation, target_rotation: (m, 3, 3) world_from_cam; rotation_sigma: (m,) radians.
        source_length, target_length: (d,) lengths of the same distances.
    """

    source: Array
    target: Array
    sigma: Array
    source_rotation: Array
    target_rotation: Array
    rotation_sigma: Array
    source_length: Array
    target_length: Array


def align_worlds(c: Correspondences, placed: bool) -> Similarity:
    """The similarity that most of the control agrees with.

    Umeyama (PAMI 1991) with weights and with orientations as further directions, re-weighted from one small subset
    after another; the one with the least sum of residuals counts.

    Args:
        placed: whether the control has a world of its own; where only lengths are known, the alignment is a scale.

    Raises:
        ReconstructionError: the control of the registered frames does not determine scale, rotation and place.
    """
    length_scale = float(np.median(c.target_length / c.source_length)) if len(c.target_length) else None
    if not placed:
        if length_scale is None:
            raise ReconstructionError("control: no length is known between registered frames and what they see")
        return Similarity(length_scale, np.eye(3), np.zeros(3))
    try:
        check_enough(c.target, c.sigma, len(c.target_rotation) > 0, length_scale is not None, c.source)
    except InputError as error:
        raise ReconstructionError(f"{error} (as far as frames are registered)") from error
    if _extent(c.target, c.source)[0] > _DISTINCT * float(np.median(c.sigma)):
        length_scale = None  # positions know better
    size = 2 if len(c.target_rotation) else 3
    subsets = [np.array(s) for s in itertools.combinations(range(len(c.target)), min(size, len(c.target)))]
    if len(subsets) > _MOST_SUBSETS:
        rng = np.random.default_rng(0)
        subsets = [subsets[i] for i in rng.choice(len(subsets), _MOST_SUBSETS, replace=False)]
    least = min((_refined(c, subset, length_scale) for subset in subsets), key=lambda found: found[0])
    return least[1]


def _refined(c: Correspondences, subset: NDArray[np.int64], length_scale: float | None) -> tuple[float, Similarity]:
    """From a few positions to all: least absolute residuals, by re-weighting."""
    weight = np.zeros(len(c.target))
    weight[subset] = 1.0
    turn = np.ones(len(c.target_rotation))
    cost, alignment = np.inf, Similarity(1.0, np.eye(3), np.zeros(3))
    for _ in range(_REWEIGHTINGS):
        alignment = _fit(c, weight, turn, length_scale)
        off = np.linalg.norm(alignment.points(c.source) - c.target, axis=1) / c.sigma
        turned = np.linalg.norm(alignment.rotations(c.source_rotation) - c.target_rotation, axis=(1, 2))
        turned = turned / (np.sqrt(2.0) * c.rotation_sigma)
        new_cost = float(np.hypot(off, 1.0).sum() + np.hypot(turned, 1.0).sum())
        if new_cost > 0.999 * cost:
            break
        cost, weight, turn = new_cost, 1.0 / np.hypot(off, 1.0), 1.0 / np.hypot(turned, 1.0)
    return cost, alignment


def _fit(c: Correspondences, weight: Array, turn: Array, length_scale: float | None) -> Similarity:
    w = weight / c.sigma**2
    source_mean, target_mean = w @ c.source / w.sum(), w @ c.target / w.sum()
    x, y = c.source - source_mean, c.target - target_mean
    power = max(float(w @ (x * x).sum(1)), 1e-30)
    scale = float(np.sqrt(w @ (y * y).sum(1) / power)) if length_scale is None else length_scale
    # |y - s R x|^2 / sigma^2 and angle^2 / sigma^2 = |W - R V|^2 / (2 sigma^2), up to what does not depend on R.
    covariance = scale * np.einsum("n,ni,nj->ij", w, y, x)
    covariance += 0.5 * np.einsum("m,mij,mkj->ik", turn / c.rotation_sigma**2, c.target_rotation, c.source_rotation)
    rotation = nearest_rotation(covariance)
    if length_scale is None:
        scale = max(float(np.einsum("n,ni,ij,nj->", w, y, rotation, x)) / power, 1e-3 * scale)
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def check_enough(target: Array, sigma: Array, turned: bool, measured: bool, source: Array | None = None) -> None:
    """Insist that known positions, rotations and lengths determine a scale, a rotation and a place.

    Args:
        target: (n, 3) known positions; sigma: (n,); source: (n, 3) the same in the solution, if there is one yet.
        turned: whether a rotation is known, too; measured: whether a length is.

    Raises:
        InputError: they do not; says what is missing.
    """
    if not len(target):
        what = "rotations alone leave" if turned else "what is known leaves"
        raise InputError(
            f"control: {what} the place of the scene open; give positions, of cameras or of points that two frames see"
        )
    least = _DISTINCT * float(np.median(sigma))
    along, off = _extent(target, target if source is None else source)
    if along <= least:
        what = "a single position leaves"
        if len(target) > 1:
            what = f"{len(target)} positions within {_DISTINCT:g} sigma of each other leave"
        if not turned:
            raise InputError(
                f"control: {what} scale and rotation open; three positions that are not on a line are needed, of "
                "cameras or of points that two frames see"
            )
        if not measured:
            raise InputError(f"control: {what} the scale open; give a distance or another position")
    elif off <= least and not turned:
        raise InputError(
            f"control: {len(target)} positions on a line (within {_DISTINCT:g} sigma, {least:.3g}) leave the rotation "
            "about it open; give a position off the line, or the rotation of a camera"
        )


def _extent(target: Array, source: Array) -> tuple[float, float]:
    """How far positions spread along the line that fits them best, and off it, in the control's world."""
    if len(target) < 2:
        return 0.0, 0.0
    known, seen = (np.linalg.svd(p - p.mean(0), compute_uv=False) for p in (target, source))
    if seen[0] <= 1e-9:
        return 0.0, 0.0
    return float(known[0]), float(min(known[1], seen[1] * known[0] / seen[0]))
