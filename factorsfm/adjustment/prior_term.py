"""The depth prior in the polish: its values at the observations, its weight, and the joint problem."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.adjustment.prior_weight import (
    PriorWeight,
    direction_angles,
    field_grid,
    measure_weight,
    sample_points,
)
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.priors.affine import KNOWN_SHIFT_SIGMA, SCALE_SIGMA, SHIFT_SIGMA, fit_affine
from factorsfm.support.options import PolishOptions
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

LEAST_CORRELATION = 0.1  # with the reconstructed inverse depth; a prior below this is not used


@dataclass(slots=True)
class PriorPart:
    """The prior as it took part in a solution.

    Attributes:
        weight: its measured error model.
        images: (p,) rows of the frames that carry it.
        observations: its values; residual, residual_sigma: (m,) see `BundleAdjustment.prior_residuals`.
        scale_std, shift_std: (p,) of the affines.
    """

    weight: PriorWeight
    images: Index
    observations: PriorObservations
    residual: Array
    residual_sigma: Array
    scale_std: Array
    shift_std: Array


@dataclass(frozen=True, slots=True)
class WeighedPrior:
    """The prior's error model, the affines that go with it, and the correlation of the pixel errors in time."""

    weight: PriorWeight
    rows: Index
    scale: Array
    shift: Array
    inflation: float


def weigh_prior(
    adjustment: BundleAdjustment,
    observations: Observations,
    tracks: Index,
    images: Sequence[ImageTracks],
    inflation: float,
) -> WeighedPrior | None:
    """Measure the error model of the prior on this shot; None without a prior."""
    values = prior_values(images, observations, tracks)
    if values is None:
        return None
    point = observations.point[values.at]
    state = adjustment.state
    q = state.camera_points(observations.frame[values.at], point)
    predicted = state.inverse_distance[point] / np.maximum(q[:, 2], 1e-6)
    scale, shift = np.ones(len(values.rows)), np.zeros(len(values.rows))
    for i in range(len(values.rows)):
        mine = values.image == i
        scale[i], shift[i], _ = fit_affine(predicted[mine], values.inverse_depth[mine], free_shift=values.free_shift)
    # One value per point: its images repeat the same error.
    seen, index, count = np.unique(point, return_inverse=True, return_counts=True)
    said = np.bincount(index, (values.inverse_depth - shift[values.image]) / scale[values.image]) / count
    mean_predicted = np.bincount(index, predicted) / count
    sample = sample_points(len(seen))
    covariance = adjustment.marginals().inverse_distances(seen[sample])
    angles = direction_angles(state.bearing[seen[sample]])
    weight = measure_weight(angles, mean_predicted[sample], said[sample], covariance * inflation)
    logger.info(
        "prior: smooth error %.2f, local %.3f of the median inverse depth, correlation %.2f; inflation %.1f",
        weight.smooth, weight.local, weight.correlation, inflation,
    )  # fmt: skip
    return WeighedPrior(weight, values.rows, scale, shift, inflation)


def joint_problem(
    state: State,
    observations: Observations,
    tracks: Index,
    images: Sequence[ImageTracks],
    weighed: WeighedPrior,
    errors: ErrorModel,
    options: PolishOptions,
) -> tuple[BundleAdjustment, PriorPart]:
    """Tracks and the prior at its weight; `errors` and `options` as in `BundleAdjustment`."""
    values = prior_values(images, observations, tracks, weighed.rows)
    assert values is not None
    first_scale, first_shift = (
        affine[np.searchsorted(weighed.rows, values.rows)] for affine in (weighed.scale, weighed.shift)
    )
    point = observations.point[values.at]
    nodes, node_weights, information, rest = field_grid(direction_angles(state.bearing), weighed.weight)
    count = np.bincount(point, minlength=len(tracks))[point]
    prior = PriorObservations(
        values.image, observations.frame[values.at], point, values.inverse_depth,
        rest[point] * first_scale[values.image] * np.sqrt(count),
        nodes[point], node_weights[point], information, SCALE_SIGMA,
        SHIFT_SIGMA if values.free_shift else KNOWN_SHIFT_SIGMA,
    )  # fmt: skip
    state = replace(state, scale=first_scale, shift=first_shift, field=np.zeros(len(information)))
    joint = BundleAdjustment(state, observations, options, errors, prior=prior)
    none = np.zeros(0)
    return joint, PriorPart(weighed.weight, values.rows, prior, none, none, none, none)


@dataclass(frozen=True, slots=True)
class PriorValues:
    """Rows of the frames with a prior; and per value its image, its observation and the inverse depth."""

    rows: Index
    image: Index
    at: Index
    inverse_depth: Array
    free_shift: bool


def prior_values(
    images: Sequence[ImageTracks], observations: Observations, tracks: Index, among: Index | None = None
) -> PriorValues | None:
    """Values of the prior at the observations, sorted as these; None where no frame (among some) carries any."""
    rows: list[int] = []
    image, at, value = [], [], []
    order = np.lexsort((observations.point, observations.frame))
    start = np.searchsorted(observations.frame[order], np.arange(len(images) + 1))
    for row, mapped in enumerate(images):
        depth = mapped.depth
        if depth is None or (among is not None and row not in among):
            continue
        here = order[start[row] : start[row + 1]]
        own = np.searchsorted(mapped.ids, tracks[observations.point[here]])
        good = depth.valid[own]
        if depth.valid.sum() < 20 or not good.any():
            continue
        image.append(np.full(int(good.sum()), len(rows)))
        rows.append(row)
        at.append(here[good])
        value.append(depth.inverse_depth[own][good])
    if not rows:
        return None
    flat = np.concatenate(at)
    by_point = np.argsort(flat, kind="stable")
    free_shift = all(images[r].depth.free_shift for r in rows)  # type: ignore[union-attr]
    return PriorValues(
        np.array(rows), np.concatenate(image)[by_point], flat[by_point], np.concatenate(value)[by_point], free_shift
    )  # fmt: skip
