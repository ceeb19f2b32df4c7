"""A camera that only turns, through whatever lens: the simplest reading of a pan, found without a map.

A pan through a wrong focal length looks like a translation over a flat world, and to the incremental map it is one. So
rotation is solved over all focal lengths by itself, from frame to frame first, in which it has no other minimum, and
then together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, image_cells
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.some_frames import some_frames
from factorsfm.adjustment.state import State
from factorsfm.lens.lens import through
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Of a guess, at which the search starts: the focal length is free, and each start leads to the same minimum from a
# factor of three away where the camera turns by a few degrees.
FACTORS = (0.6, 1.2, 2.4)
_ITERATIONS = 8
_SIGMAS_PX = (4.0 * FIRST_SIGMA_PX, FIRST_SIGMA_PX)  # first wide: rotations from frame to frame have drifted
_CELLS = (8, 5)  # across and down; what fills one counts once, however many tracks it has
_FEWEST = 6  # tracks that two frames have in common, from which a rotation is estimated
_WIDTHS_PX = (8.0, 4.0, 2.0, 1.0, 1.0, 1.0)  # of the kernel of a frame's rotation, from wide to narrow


def turning_camera(
    guess: State, observations: Observations, options: PolishOptions, factors: tuple[float, ...] = FACTORS
) -> State:
    """The camera that only turns before points at one distance, with the focal length that explains most.

    Args:
        guess: whose lens the search starts from, and whose world is kept; it has one focal length.
        factors: of its focal length, at which the search starts.
    """
    fits = []
    for factor in factors:
        _, part, few = some_frames(
            _chained(through(guess, factor * np.exp(guess.log_focal)), observations), observations
        )
        for sigma in _SIGMAS_PX:
            solved = BundleAdjustment(
                part, few, replace(options, iterations=_ITERATIONS, tolerance=1e-3), ErrorModel(sigma),
                free=Free(translation=False, focal=True),
            )  # fmt: skip
            part = solved.solve()
        fits.append((solved.cost(), part.log_focal))
    _, log_focal = min(fits, key=lambda fit: fit[0])
    return _chained(through(guess, np.exp(log_focal)), observations)


def _chained(guess: State, observations: Observations) -> State:
    """Rotations frame by frame on the mean directions of what was seen before; through the lens of the guess."""
    o, count = observations, len(guess.rotation)
    xy = guess.normalized(o)
    ray = np.column_stack([xy, np.ones(len(xy))])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    rotation, seen = np.tile(np.eye(3), (count, 1, 1)), np.zeros((len(guess.bearing), 3))
    for k, here in enumerate(o.rows_by_frame(count)):
        before = seen[o.point[here]]
        length = np.linalg.norm(before, axis=1)
        known = length > 0
        last = rotation[max(k - 1, 0)]
        if known.sum() >= _FEWEST:
            last = turn_to(before[known] / length[known, None], ray[here][known], last, float(guess.focal[k]))
        rotation[k] = last
        seen[o.point[here]] += ray[here] @ last
    still = replace(
        guess,
        rotation=rotation,
        translation=np.zeros_like(guess.translation),
        bearing=seen / np.linalg.norm(seen, axis=1, keepdims=True),
        inverse_distance=np.ones(len(seen)),
        world=0,
    )
    return still.seen_from(guess.world)


def turn_to(before: Array, ray: Array, start: Array, focal: float) -> Array:
    """The rotation that takes unit directions to rays, (n, 3) each, by re-weighted least squares over the image.

    Args:
        start: the rotation of a frame nearby; focal: pixels.
    """
    cell = image_cells(ray[:, :2], *_CELLS)
    area = 1.0 / np.bincount(cell)[cell]
    turn = start
    for least in _WIDTHS_PX:
        off = focal * np.linalg.norm(ray - before @ turn.T, axis=1)
        width = max(least, float(np.median(off)))  # a fast pan leaves the prediction far behind, all over the image
        weight = area / (1.0 + (off / width) ** 2) ** 2
        u, _, v = np.linalg.svd((ray * weight[:, None]).T @ before)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.asarray(turn)
