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
_LEAST_CORRELATION = 0.1  # with the reconstructed inverse depth; below this, or mirrored, a prior is none
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
    core, few, adjustment = _converge_cameras(state, observations, options)
    focal_std = None
    if options.refine_focal_length:
        adjustment, focal_std = _checked_focal(adjustment, few, o, focal)
    motion = classify_motion(adjustment, few, o)
    weighed = None
    if motion.kind is ShotKind.GENERAL:
        if o.depth:
            weighed = _weigh_prior(adjustment, few, tracks[core], used)
        part = adjustment.state
    else:
        part = motion.rotation_only
    free = motion.kind is ShotKind.GENERAL

    progress("polish: points")
    sigma = adjustment.sigma
    state = _with_part(state, part, core)
    state = BundleAdjustment(state, observations, replace(o, iterations=4), sigma=sigma, points_only=True).solve()
    observations, tracks, state = _without_outliers(state, observations, tracks, sigma, o)
    progress("polish: all tracks")
    prior = None
    if weighed is not None:
        adjustment, prior = _joint(state, observations, tracks, used, weighed, sigma, o)
    else:
        adjustment = BundleAdjustment(state, observations, o, sigma=sigma, free_translation=free)
    adjustment.solve(o.final_iterations)
    if prior is not None:
        prior.residual = adjustment.prior_residuals()
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
    images: list[MappedImage],
    observations: Observations,
    tracks: Index,
    map_points: tuple[Index, Array],
    focal: float,
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
        turn,
        translation,
        some,
        focal=focal,
        inlier_px=5.0,
        sigma=_FIRST_SIGMA_PX,
        fallback=np.ones(len(tracks)),
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


def _converge_cameras(
    state: State, observations: Observations, options: Options
) -> tuple[Index, Observations, BundleAdjustment]:
    """All cameras on the core tracks, first with a wide kernel: the points, their observations, the solution."""
    o = options.polish
    core = _core(observations, len(state.rotation), _CORE_TRACKS)
    few = _subset(observations, core)
    part = replace(state, bearing=state.bearing[core], inverse_distance=state.inverse_distance[core])
    errors = BundleAdjustment(part, few, o, sigma=1.0).reprojection_errors()
    sigma = max(_FIRST_SIGMA_PX, _noise(errors))
    adjustment = BundleAdjustment(part, few, replace(o, iterations=20, tolerance=1e-3), sigma=sigma)
    adjustment.solve()
    sigma = min(sigma, _noise(adjustment.reprojection_errors()))
    adjustment = BundleAdjustment(adjustment.state, few, o, sigma=sigma, free_focal=options.refine_focal_length)
    adjustment.solve()
    logger.debug("cameras: %d iterations, %.3f px", adjustment.iterations, sigma)
    adjustment.sigma = _noise(adjustment.reprojection_errors())
    return core, few, adjustment


def _with_part(state: State, part: State, core: Index) -> State:
    """The cameras and core points of `part`, the other points of `state`."""
    bearing, inverse = state.bearing.copy(), state.inverse_distance.copy()
    bearing[core], inverse[core] = part.bearing, part.inverse_distance
    return replace(part, bearing=bearing, inverse_distance=inverse)


def _without_outliers(
    state: State, observations: Observations, tracks: Index, sigma: float, options: PolishOptions
) -> tuple[Observations, Index, State]:
    """Drop tracks whose typical error is far outside that of all tracks (log scale, robust)."""
    errors = BundleAdjustment(state, observations, options, sigma=sigma).reprojection_errors()
    start = np.searchsorted(observations.point, np.arange(len(tracks)))
    count = np.diff(np.append(start, len(errors)))
    typical = np.log(np.sqrt(np.add.reduceat(errors**2, start) / count) + 1e-6)
    center = np.median(typical)
    spread = 1.4826 * np.median(np.abs(typical - center))
    keep = np.nonzero(typical < center + options.outlier_sigmas * max(spread, 0.1))[0]
    state = replace(state, bearing=state.bearing[keep], inverse_distance=state.inverse_distance[keep])
    return _subset(observations, keep), tracks[keep], state


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


@dataclass(frozen=True, slots=True)
class _Weighed:
    """The prior's error model, the affines that go with it, and the correlation of the pixel errors in time."""

    weight: PriorWeight
    rows: Index
    scale: Array
    shift: Array
    inflation: float


def _weigh_prior(
    adjustment: BundleAdjustment, observations: Observations, tracks: Index, images: list[MappedImage]
) -> _Weighed | None:
    """Measure how far the prior can be trusted on this shot; None where there is none or it is no prior."""
    values = _prior_values(images, observations, tracks)
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
    inflation = _temporal_inflation(adjustment, observations)
    _, covariance = adjustment.covariance(seen[sample])
    angles = direction_angles(state.bearing[seen[sample]])
    weight = measure_weight(angles, mean_predicted[sample], said[sample], covariance * inflation)
    logger.info(
        "prior: smooth error %.2f, local %.3f of the median inverse depth, correlation %.2f; inflation %.1f",
        weight.smooth, weight.local, weight.correlation, inflation,
    )  # fmt: skip
    if weight.correlation < _LEAST_CORRELATION:
        return None
    return _Weighed(weight, values.rows, scale, shift, inflation)


def _joint(
    state: State,
    observations: Observations,
    tracks: Index,
    images: list[MappedImage],
    weighed: _Weighed,
    sigma: float,
    options: PolishOptions,
) -> tuple[BundleAdjustment, PriorPart]:
    """The final problem: all tracks, and the prior at its weight."""
    values = _prior_values(images, observations, tracks)
    assert values is not None
    point = observations.point[values.at]
    nodes, node_weights, information, rest = field_grid(direction_angles(state.bearing), weighed.weight)
    count = np.bincount(point, minlength=len(tracks))[point]
    prior = PriorObservations(
        values.image, observations.frame[values.at], point, values.inverse_depth,
        rest[point] * weighed.scale[values.image] * np.sqrt(count),
        nodes[point], node_weights[point], information, _SCALE_SIGMA,
        _SHIFT_SIGMA if values.free_shift else _NO_SHIFT_SIGMA,
    )  # fmt: skip
    state = replace(state, scale=weighed.scale, shift=weighed.shift, field=np.zeros(len(information)))
    # Pixel errors that repeat themselves weigh less against the prior; the kernel keeps its width in pixels.
    wide = float(np.sqrt(weighed.inflation))
    options = replace(options, kernel=options.kernel / wide)
    joint = BundleAdjustment(state, observations, options, sigma=sigma * wide, prior=prior)
    none = np.zeros(0)
    return joint, PriorPart(weighed.weight, values.rows, prior, none, none, none)


@dataclass(frozen=True, slots=True)
class _PriorValues:
    """Rows of the frames with a prior; and per value its image, its observation and the inverse depth."""

    rows: Index
    image: Index
    at: Index
    inverse_depth: Array
    free_shift: bool


def _prior_values(images: list[MappedImage], observations: Observations, tracks: Index) -> _PriorValues | None:
    """Values of the prior at the observations, sorted as these; None where no frame carries any."""
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
    free_shift = all(images[r].tracks.depth.free_shift for r in rows)  # type: ignore[union-attr]
    return _PriorValues(
        np.array(rows), np.concatenate(image)[by_point], flat[by_point], np.concatenate(value)[by_point], free_shift
    )  # fmt: skip
