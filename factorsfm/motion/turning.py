"""Groups of tracks that turn together: the scene, and what moves before it, as far as a turning camera can tell.

With little parallax the scene turns almost as one, and so does each thing that moves by itself. A full motion of the
camera explains two of them at once, one as near and the other as far; a turn alone does not. So turns tell apart what
may be explained separately; they do not tell which of the groups is the scene.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import image_cells
from factorsfm.adjustment.observations import Observations
from factorsfm.motion.at_rest import image_weights

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]
Pair = tuple[Index, Array, Array]

_STEPS = 20  # of the time, over each of which turns are compared
_SEEDS = (4, 3)  # parts of the image, across and down, of which each begins a group
_LEAST_TURNING = 4  # points of a step from which a turn is estimated
_ROUNDS = 6  # of alternating turns and membership
_LEAST, _LEAST_SHARE = 12, 0.08  # points of a group, and its share of the image: less does no harm
_GROUPS = 3
_FLOOR_PX = 1.0  # distance below which two turns are not told apart
_SPREADS = 3.0  # typical distances of a group's points from its turn, within which a point belongs to it


def turning_groups(observations: Observations, xy: Array, focal: float) -> list[Flags]:
    """Groups of points, that of the largest part of the image first; none where all turn together.

    Args:
        xy: (n, 2) normalised image coordinates of the observations; focal: pixels.

    Returns:
        For each group (n,) which points belong to it.
    """
    pairs = _pairs(observations, xy)
    seeds = image_cells(observations.pixels[observations.first], *_SEEDS)
    weights = image_weights(observations)
    share = np.asarray(np.bincount(observations.point, weights / weights.sum()), np.float64)
    free = np.ones(len(share), bool)
    groups: list[Flags] = []
    while len(groups) < _GROUPS and _is_large(free, share):
        group = _largest(pairs, seeds, free, share, focal)
        if not _is_large(group, share):
            break
        groups.append(group)
        free &= ~group
    return groups if len(groups) > 1 else []


def _is_large(group: Flags, share: Array) -> bool:
    return bool(group.sum() >= _LEAST and share[group].sum() >= _LEAST_SHARE)


def _pairs(observations: Observations, xy: Array) -> list[Pair]:
    """For each step of the time: the points that are seen at both ends, and their rays there, (m, 3) each."""
    o = observations
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    last = int(o.frame.max())
    ends = np.unique(np.linspace(0, last, min(last, _STEPS) + 1).astype(int))
    rows = [np.flatnonzero(o.frame == end) for end in ends]
    found = []
    for a, b in pairwise(rows):
        points, in_a, in_b = np.intersect1d(o.point[a], o.point[b], assume_unique=True, return_indices=True)
        found.append((points, rays[a[in_a]], rays[b[in_b]]))
    return found


def _largest(pairs: list[Pair], seeds: Index, free: Flags, share: Array, focal: float) -> Flags:
    """The group of free points with the largest share that turns with one of the seeds, as turns and members settle."""
    grown = [_turning_with((seeds == seed) & free, pairs, free, focal) for seed in np.unique(seeds[free])]
    group = max(grown, key=lambda members: float(share[members].sum()))
    for _ in range(_ROUNDS):
        before, group = group, _turning_with(group, pairs, free, focal)
        if (group == before).all():
            break
    return group


def _turning_with(members: Flags, pairs: list[Pair], free: Flags, focal: float) -> Flags:
    """(n,) which free points turn as most of the members do."""
    distance = np.full((len(pairs), len(free)), np.nan)
    for k, (points, a, b) in enumerate(pairs):
        mine = members[points]
        if mine.sum() >= _LEAST_TURNING:
            distance[k, points] = focal * np.linalg.norm(b - a @ _turn(a[mine], b[mine]).T, axis=1)
    typical = np.full(len(free), np.inf)
    seen = np.isfinite(distance).any(axis=0)
    typical[seen] = np.nanmedian(distance[:, seen], axis=0)
    of_members = typical[members & seen]
    if not len(of_members):
        return np.zeros(len(free), bool)
    limit = max(_FLOOR_PX, _SPREADS * float(np.quantile(of_members, 0.3)))
    return np.asarray(free & (typical < limit))


def _turn(a: Array, b: Array) -> Array:
    """Rotation that takes most of the rays a to b, (m, 3) each: of least absolute distance."""
    weight = np.ones(len(a))
    for _ in range(8):
        u, _, v = np.linalg.svd((weight[:, None] * b).T @ a)
        turn = np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)
        distance = np.linalg.norm(b - a @ turn.T, axis=1)
        weight = 1.0 / np.maximum(distance, max(1e-6, float(np.quantile(distance, 0.2)))) ** 2
    return turn
