"""From the incremental map to the final result: all frames and all tracks, with the prior at the weight it earns."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapper import MappedImage
from factorsfm.observability import Motion, classify_motion
from factorsfm.options import Options, PolishOptions
from factorsfm.prior_weight import PriorWeight, direction_angles, field_grid, measure_weight, sample_points
from factorsfm.reconstruction import ShotKind
from factorsfm.refinement import BundleAdjustment, Observations, PriorObservations, State
from factorsfm.registration import fit_affine
from factorsfm.triangulation import triangulate

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_FIRST_SIGMA_PX = 0.25
_SMALLEST_SIGMA_PX = 0.03
_RAYLEIGH_MEDIAN = 1.1774  # median of the norm of a 2-D error, in standard deviations
_CORE_TRACKS = 400  # tracks with which the cameras converge first
_TRIANGULATION_VIEWS = 10
_FOCAL_STD = 0.05  # relative standard deviation up to which a focal length counts as determined
_SCALE_SIGMA, _SHIFT_SIGMA, _NO_SHIFT_SIGMA = 0.5, 0.3, 0.02


@dataclass(slots=True)
class PriorPart:
    """What the prior did.

    Attributes:
        weight: its measured error model.
        images: (p,) rows of the frames that carry it.
        observations: its values; residual: (m,) in units of its inverse depth.
        scale_std, shift_std: (p,) of the affines.
    """

    weight: PriorWeight
    images: Index
    observations: PriorObservations
    residual: Array
    scale_std: Array
    shift_std: Array


@dataclass(slots=True)
class Polished:
    """Result of the polish; the first registered camera is the world, the median inverse distance is about 1.

    Attributes:
        frames: (k,) positions of the images in `state`; tracks: (n,) track of each point.
        errors: (m,) reprojection errors of `observations` (pixels); sigma: their standard deviation.
        covariance: (k, 6, 6) of the poses, GTSAM's convention.
        focal_std: relative standard deviation of the focal length, None where it was not estimated.
    """

    frames: list[int]
    state: State
    tracks: Index
    observations: Observations
    errors: Array
    sigma: float
    motion: Motion
    covariance: Array
    prior: PriorPart | None = None
    focal_std: float | None = None
    notes: list[str] = field(default_factory=list)


def polish(
    images: list[MappedImage],
    map_points: tuple[Index, Array],
    focal: float,
    options: Options,
    progress: Callable[[str], None] = lambda stage: None,
) -> Polished:
    """Triangulate all tracks and minimise over all registered frames.

    Args:
        images: at least one registered; map_points: track ids and positions of the incremental map.
        focal: pixels, a first guess where the options refine it.
    """
    o = options.polish
    frames = [i for i, image in enumerate(images) if image.registered]
    used = [images[i] for i in frames]
    observations, tracks = _gather(used, min(o.min_track_length, max(2, len(used))))
    state = _first_guess(used, observations, tracks, map_points, focal)

    progress("polish: cameras")
    state, sigma = _converge_cameras(state, observations, o)
    progress("polish: points")
    state = BundleAdjustment(
        state, observations, replace(o, iterations=5), sigma=sigma, points_only=True
    ).solve()
    adjustment = BundleAdjustment(state, observations, replace(o, iterations=5), sigma=sigma)
    adjustment.solve()
    observations, tracks, state = _without_outliers(adjustment, observations, tracks, o.outlier_sigmas)
    sigma = _noise(adjustment.reprojection_errors())
    progress("polish: all")
    adjustment = BundleAdjustment(state, observations, o, sigma=sigma, free_focal=options.refine_focal_length)
    adjustment.solve()
    focal_std = None
    if options.refine_focal_length:
        adjustment, focal_std = _checked_focal(adjustment, observations, o, focal)

    motion = _classify(adjustment, observations, o)
    prior = None
    if motion.kind is ShotKind.GENERAL:
        if o.depth:
            progress("polish: prior")
            adjustment, prior = _with_prior(adjustment, observations, tracks, used, o)
    else:
        still = motion.rotation_only
        adjustment = BundleAdjustment(still, observations, o, sigma=adjustment.sigma, free_translation=False)
        adjustment.solve()
    camera_covariance, _ = adjustment.covariance(np.zeros(0, np.int64))
    k = len(frames)
    poses = np.stack([camera_covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(k)])
    if prior is not None:
        affine = np.sqrt(camera_covariance.diagonal()[6 * k + 1 : 6 * k + 1 + 2 * len(prior.images)])
        prior.scale_std, prior.shift_std = affine[::2], affine[1::2]
    return Polished(
        frames, adjustment.state, tracks, observations, adjustment.reprojection_errors(), adjustment.sigma,
        motion, poses, prior, focal_std,
    )  # fmt: skip


# --- set-up -----------------------------------------------------------------------------------------------------


def _gather(images: list[MappedImage], min_length: int) -> tuple[Observations, Index]:
    """Observations of all tracks that are long enough, sorted by track, and the tracks' ids."""
    frame = np.concatenate([np.full(len(i.tracks.ids), k) for k, i in enumerate(images)])
    track = np.concatenate([i.tracks.ids for i in images])
    xy = np.concatenate([i.tracks.xy for i in images])
    ids, point, count = np.unique(track, return_inverse=True, return_counts=True)
    keep = count[point] >= min_length
    frame, point, xy = frame[keep], point[keep], xy[keep]
    kept, point = np.unique(point, return_inverse=True)
    order = np.lexsort((frame, point))
    return Observations(frame[order], point[order], xy[order]), ids[kept]


def _first_guess(
    images: list[MappedImage], observations: Observations, tracks: Index, map_points: tuple[Index, Array], focal: float
) -> State:
    """Poses in the first camera's frame, points triangulated from a few views, median inverse distance 1."""
    first = images[0]
    assert first.rotation is not None
    assert first.translation is not None
    turn = np.array([i.rotation for i in images]) @ first.rotation.T
    translation = np.array([i.translation for i in images]) - turn @ first.translation
    ids, points = map_points
    points = points @ first.rotation.T + first.translation
    distance = np.linalg.norm(points, axis=1)
    unit = float(np.median(1.0 / np.maximum(distance, 1e-6)))
    translation = translation * unit
    views = np.unique(np.linspace(0, len(images) - 1, _TRIANGULATION_VIEWS).astype(int))
    few = np.isin(observations.frame, views)
    first_of_track = np.zeros(len(few), bool)
    first_of_track[np.searchsorted(observations.point, np.arange(len(tracks)))] = True
    some = Observations(*(a[few | first_of_track] for a in (observations.frame, observations.point, observations.xy)))
    result = triangulate(
        turn, translation, some, focal=focal, inlier_px=5.0, sigma=_FIRST_SIGMA_PX, fallback=np.ones(len(tracks))
    )
    bearing, inverse = result.bearing.copy(), result.inverse_distance.copy()
    mapped = np.isin(tracks, ids)
    at = np.searchsorted(ids, tracks[mapped])
    bearing[mapped] = points[at] / distance[at, None]
    inverse[mapped] = 1.0 / np.maximum(distance[at] * unit, 1e-3)
    inverse = np.clip(inverse, 0.02, 20.0)
    return State(turn, translation, bearing, inverse, float(np.log(focal)))


def _subset(observations: Observations, points: Index) -> Observations:
    """Observations of some points (ascending), renumbered."""
    keep = np.isin(observations.point, points)
    return Observations(
        observations.frame[keep], np.searchsorted(points, observations.point[keep]), observations.xy[keep]
    )


def _core(observations: Observations, frames: int, count: int) -> Index:
    """Points that hold the cameras together: the longest tracks, but enough of them in every frame."""
    length = np.bincount(observations.point)
    order = np.argsort(-length, kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    chosen = rank < count
    by_frame = np.lexsort((rank[observations.point], observations.frame))
    first = np.searchsorted(observations.frame[by_frame], np.arange(frames))
    place = np.arange(len(by_frame)) - first[observations.frame[by_frame]]
    chosen[observations.point[by_frame[place < count // 3]]] = True
    return np.nonzero(chosen)[0]


# --- stages -----------------------------------------------------------------------------------------------------


def _noise(errors: Array) -> float:
    return max(float(np.median(errors)) / _RAYLEIGH_MEDIAN, _SMALLEST_SIGMA_PX)


def _converge_cameras(state: State, observations: Observations, options: PolishOptions) -> tuple[State, float]:
    """All cameras on the core tracks, first with a wide kernel."""
    core = _core(observations, len(state.rotation), _CORE_TRACKS)
    few = _subset(observations, core)
    part = replace(state, bearing=state.bearing[core], inverse_distance=state.inverse_distance[core])
    errors = BundleAdjustment(part, few, options, sigma=1.0).reprojection_errors()
    sigma = max(_FIRST_SIGMA_PX, _noise(errors))
    adjustment = BundleAdjustment(part, few, replace(options, iterations=20, tolerance=1e-3), sigma=sigma)
    adjustment.solve()
    sigma = min(sigma, _noise(adjustment.reprojection_errors()))
    adjustment = BundleAdjustment(adjustment.state, few, options, sigma=sigma)
    part = adjustment.solve()
    logger.debug("cameras: %d iterations, %.3f px", adjustment.iterations, sigma)
    bearing, inverse = state.bearing.copy(), state.inverse_distance.copy()
    bearing[core], inverse[core] = part.bearing, part.inverse_distance
    state = replace(part, bearing=bearing, inverse_distance=inverse)
    return state, _noise(adjustment.reprojection_errors())


def _without_outliers(
    adjustment: BundleAdjustment, observations: Observations, tracks: Index, sigmas: float
) -> tuple[Observations, Index, State]:
    """Drop tracks whose typical error is far outside that of all tracks (log scale, robust)."""
    errors = adjustment.reprojection_errors()
    start = np.searchsorted(observations.point, np.arange(len(tracks)))
    count = np.diff(np.append(start, len(errors)))
    typical = np.log(np.sqrt(np.add.reduceat(errors**2, start) / count) + 1e-6)
    center = np.median(typical)
    spread = 1.4826 * np.median(np.abs(typical - center))
    keep = np.nonzero(typical < center + sigmas * max(spread, 0.1))[0]
    state = adjustment.state
    return (
        _subset(observations, keep),
        tracks[keep],
        replace(state, bearing=state.bearing[keep], inverse_distance=state.inverse_distance[keep]),
    )


def _checked_focal(
    adjustment: BundleAdjustment, observations: Observations, options: PolishOptions, guess: float
) -> tuple[BundleAdjustment, float]:
    """The estimated focal length where the shot determines it, else the guess."""
    covariance, _ = adjustment.covariance(np.zeros(0, np.int64))
    column = 6 * len(adjustment.state.rotation)
    std = float(np.sqrt(covariance[column, column] * _temporal_inflation(adjustment, observations)))
    if std > _FOCAL_STD or not 0.3 < float(np.exp(adjustment.state.log_focal)) / guess < 3.0:
        scaled = replace(adjustment.state, log_focal=float(np.log(guess)))
        adjustment = BundleAdjustment(scaled, observations, options, sigma=adjustment.sigma)
        adjustment.solve()
    return adjustment, std


def _classify(adjustment: BundleAdjustment, observations: Observations, options: PolishOptions) -> Motion:
    core = _core(observations, len(adjustment.state.rotation), _CORE_TRACKS)
    state = adjustment.state
    part = replace(state, bearing=state.bearing[core], inverse_distance=state.inverse_distance[core])
    few = _subset(observations, core)
    motion = classify_motion(
        BundleAdjustment(part, few, options, sigma=adjustment.sigma), few, options
    )
    rotation_only = replace(
        motion.rotation_only, bearing=state.bearing.copy(), inverse_distance=state.inverse_distance.copy()
    )
    rotation_only.bearing[core] = motion.rotation_only.bearing
    return replace(motion, rotation_only=rotation_only)


def _temporal_inflation(adjustment: BundleAdjustment, observations: Observations) -> float:
    """By how much the errors of a track in neighbouring frames repeat each other, as a factor on the variance."""
    residual = adjustment.reprojection_vectors()
    next_one = (np.diff(observations.point) == 0) & (np.diff(observations.frame) == 1)
    if next_one.sum() < 100:
        return 1.0
    size = np.linalg.norm(residual, axis=1)
    inlier = size < 3.0 * np.median(size)
    pair = np.nonzero(next_one & inlier[:-1] & inlier[1:])[0]
    a, b = residual[pair], residual[pair + 1]
    correlation = float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))
    correlation = min(max(correlation, 0.0), 0.9)
    return (1.0 + correlation) / (1.0 - correlation)


def _with_prior(
    adjustment: BundleAdjustment,
    observations: Observations,
    tracks: Index,
    images: list[MappedImage],
    options: PolishOptions,
) -> tuple[BundleAdjustment, PriorPart | None]:
    """Measure how far the prior can be trusted on this shot, then solve once more with it."""
    values = _prior_values(images, observations, tracks)
    if values is None:
        return adjustment, None
    rows, image, at, inverse_depth, free_shift = values
    frame, point = observations.frame[at], observations.point[at]
    state = adjustment.state
    q = state.camera_points(frame, point)
    predicted = state.inverse_distance[point] / np.maximum(q[:, 2], 1e-6)
    scale, shift = np.ones(len(rows)), np.zeros(len(rows))
    for i in range(len(rows)):
        mine = image == i
        scale[i], shift[i], _ = fit_affine(predicted[mine], inverse_depth[mine], free_shift=free_shift)
    # One value per point: its images repeat the same error.
    seen, index, count = np.unique(point, return_inverse=True, return_counts=True)
    said = np.bincount(index, (inverse_depth - shift[image]) / scale[image]) / count
    mean_predicted = np.bincount(index, predicted) / count
    sample = sample_points(len(seen))
    inflation = _temporal_inflation(adjustment, observations)
    _, covariance = adjustment.covariance(seen[sample])
    angles = direction_angles(state.bearing[seen])
    weight = measure_weight(angles[sample], mean_predicted[sample], said[sample], covariance * inflation)
    logger.info(
        "prior: smooth error %.2f, local %.2f of the median inverse depth, correlation %.2f; inflation %.1f",
        weight.smooth, weight.local, weight.correlation, inflation,
    )  # fmt: skip
    if weight.correlation < 0.1:
        return adjustment, None
    nodes, node_weights, information = field_grid(angles, weight)
    prior = PriorObservations(
        image, frame, point, inverse_depth,
        weight.local * scale[image] * np.sqrt(count[index]),
        nodes[index], node_weights[index], information, _SCALE_SIGMA,
        _SHIFT_SIGMA if free_shift else _NO_SHIFT_SIGMA,
    )  # fmt: skip
    state = replace(state, scale=scale, shift=shift, field=np.zeros(len(information)))
    wide = float(np.sqrt(inflation))
    joint = BundleAdjustment(
        state, observations, replace(options, kernel=options.kernel / wide, iterations=15),
        sigma=adjustment.sigma * wide, prior=prior,
    )  # fmt: skip
    joint.solve()
    none = np.zeros(len(rows))
    return joint, PriorPart(weight, rows, prior, joint.prior_residuals(), none, none)


def _prior_values(
    images: list[MappedImage], observations: Observations, tracks: Index
) -> tuple[Index, Index, Index, Array, bool] | None:
    """Rows of the frames with a prior; and per value its image, its observation, and the inverse depth."""
    rows, image, at, value = [], [], [], []
    order = np.lexsort((observations.point, observations.frame))
    start = np.searchsorted(observations.frame[order], np.arange(len(images) + 1))
    for row, mapped in enumerate(images):
        depth = mapped.tracks.depth
        if depth is None:
            continue
        here = order[start[row] : start[row + 1]]
        own = np.searchsorted(mapped.tracks.ids, tracks[observations.point[here]])
        good = depth.valid[own]
        if good.sum() < 20:
            continue
        image.append(np.full(int(good.sum()), len(rows)))
        rows.append(row)
        at.append(here[good])
        value.append(depth.inverse_depth[own][good])
    if not rows:
        return None
    flat = np.concatenate(at)
    by_point = np.argsort(flat, kind="stable")
    free_shift = all(images[r].tracks.depth.free_shift for r in rows)  # type: ignore[union-attr]
    return (
        np.array(rows), np.concatenate(image)[by_point], flat[by_point], np.concatenate(value)[by_point], free_shift
    )  # fmt: skip
