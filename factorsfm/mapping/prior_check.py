"""Whether a depth prior says anything of the scene at all.

An error of the network is the same error in the next frame, and so it does little harm to poses: that is a matter of
weights. But maps that give the same points another order of depths every time tell of no scene. This shows at once,
long before there is the parallax that could contradict them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage

_LEAST_AGREEMENT = 0.25  # rank correlation; of networks it is about 0.95, of noise in each pixel of 40 % still 0.33
_LEAST_PAIRS = 3  # of keyframes
_LEAST_TRACKS = 20  # that both see and have a depth for
_LEAST_SPREAD = 0.05  # of the depths, half of them, over their median: those of a wall have no order to contradict


def inconsistency(keyframes: Sequence[MappedImage]) -> str:
    """Why the depth maps of some keyframes, in order of time, are no prior; empty where they may be one."""
    guided = [image for image in keyframes if image.tracks.depth is not None]
    agreements = [r for r in (_agreement(a, b) for a, b in pairwise(guided)) if r is not None]
    if len(agreements) < _LEAST_PAIRS or (typical := float(np.median(agreements))) >= _LEAST_AGREEMENT:
        return ""
    return (
        f"the order of its depths correlates from keyframe to keyframe by {typical:.2f}, "
        f"at least {_LEAST_AGREEMENT} expected"
    )


def _agreement(a: MappedImage, b: MappedImage) -> float | None:
    """Rank correlation of what two depth maps say of the same points; None where these are too few, or a wall."""
    assert a.tracks.depth is not None
    assert b.tracks.depth is not None
    _, in_a, in_b = np.intersect1d(a.tracks.ids, b.tracks.ids, assume_unique=True, return_indices=True)
    both = a.tracks.depth.valid[in_a] & b.tracks.depth.valid[in_b]
    if both.sum() < _LEAST_TRACKS:
        return None
    said = a.tracks.depth.inverse_depth[in_a][both], b.tracks.depth.inverse_depth[in_b][both]
    if any(_spread(values) < _LEAST_SPREAD for values in said):
        return None
    return float(np.corrcoef(_ranks(said[0]), _ranks(said[1]))[0, 1])


def _spread(values: NDArray[np.float64]) -> float:
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return float((high - low) / median)


def _ranks(values: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.argsort(np.argsort(values))
