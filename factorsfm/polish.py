"""From the incremental map to the final result: all frames and all tracks, with the prior at the weight it earns."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.control import LocatedControl
from factorsfm.controlled import controlled, frames_under_control
from factorsfm.converge import converge_cameras, core_tracks
from factorsfm.evaluation.alignment import Similarity
from factorsfm.images import MappedImage, gather
from factorsfm.lens import Lens, LensEstimate, estimate_lens
from factorsfm.marginals import in_scene_unit
from factorsfm.noise import FIRST_SIGMA_PX, SMALLEST_SIGMA_PX, block_inflation
from factorsfm.observability import Motion, camera_observability, classify_motion, pose_blocks
from factorsfm.options import Options, PolishOptions
from factorsfm.prior_term import PriorPart, joint_problem, weigh_prior
from factorsfm.problem import Observations, State
from factorsfm.reconstruction import CameraObservability, ControlFit, ShotKind
from factorsfm.refinement import BundleAdjustment
from factorsfm.registration import register_image
from factorsfm.triangulation import Triangulation, triangulate
from factorsfm.zoom import find_zoom

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_TRIANGULATION_VIEWS = 10


@dataclass(slots=True)
class Polished:
    """Result of the polish; the first registered camera is the world, the median inverse distance is about 1.

    Attributes:
        frames: (k,) positions of the images in `state`; tracks: (n,) track of each point.
        errors: (m,) reprojection errors of `observations` (pixels); sigma: their standard deviation.
        covariance: (k, 6, 6) of the poses, GTSAM's convention, `in_scene_unit`.
        observability: what carries each of them.
        point_std: (n,) standard deviations of the inverse distances, in the same unit.
        lens: what became of an unknown lens, None where it is known.
        datum, control: from this world to that of the control, and what the control did; None without control.
        control_unused: whether there is control that could not take part.
    """

    frames: list[int]
    state: State
    tracks: Index
    observations: Observations
    errors: Array
    sigma: float
    motion: Motion
    covariance: Array
    observability: list[CameraObservability]
    point_std: Array
    prior: PriorPart | None = None
    lens: LensEstimate | None = None
    datum: Similarity | None = None
    control: ControlFit | None = None
    control_unused: bool = False


def polish(
    images: list[MappedImage],
    map_points: tuple[Index, Array],
    focal: Array,
    options: Options,
    progress: Callable[[str], None] = lambda stage: None,
    shape: Array | None = None,
    groups: Index | None = None,
    control: LocatedControl | None = None,
    first_focal: Array | None = None,
) -> Polished:
    """Triangulate all tracks and minimise over all registered frames.

    Args:
        images: at least one registered; map_points: track ids and positions of the incremental map.
        focal: (g,) focal lengths, pixels; first guesses where the options refine them.
        shape: (4,) distortion of the lens as in `factors.distort` where the options refine the lens; None is none.
        groups: (images,) which of the focal lengths is that of each image; None: all have the first.
        first_focal: (g,) what was thought of the focal lengths first, to which they return where the shot does not
            determine them; None: `focal`.
        control: what is known beforehand, its marks normalised as the tracks are; it takes part at the end, and only
            where the camera moves.

    Raises:
        ReconstructionError: what is known of the registered frames leaves open where the world of the control is.
    """
    o = options.polish
    registered = [i for i, image in enumerate(images) if image.registered]
    frames = _solved_frames(images, registered, o.max_frames)
    if control is not None:
        frames = sorted({*frames, *frames_under_control(registered, control, o.max_frames // 2)})
    used = [images[i] for i in frames]
    observations, tracks = _gather(used, min(o.min_track_length, max(2, len(used))))
    groups = np.zeros(len(images), np.int64) if groups is None else groups

    progress("polish: cameras")
    core = core_tracks(observations, len(frames))
    few = observations.of(core)
    start = _first_guess(used, few, tracks[core], map_points, focal, groups[frames])
    adjustment = converge_cameras(start, few, options)
    lens = None
    if options.refine_focal_length:
        guess = Lens(focal, np.zeros(4) if shape is None else shape)
        adjustment, lens = _estimate_lens(adjustment, guess, frames, options, first_focal)
        few, group = adjustment.observations, adjustment.state.group
        observations = lens.renormalize(observations, group)
        if control is not None:
            zooms = len(lens.lens.focal) > len(focal)
            whole, of_image = (
                (_between(lens, frames, np.arange(len(images))), np.arange(len(images))) if zooms else (lens, groups)
            )
            control = replace(control, marks=whole.renormalize(control.marks, of_image))
    motion = classify_motion(adjustment, few, o)
    inflation = block_inflation(adjustment.reprojection_vectors(), few)
    weighed = None
    if motion.kind is ShotKind.GENERAL:
        if o.depth:
            weighed = weigh_prior(adjustment, few, tracks[core], used, inflation)
        part = adjustment.state
    else:
        part = motion.rotation_only
    free = motion.kind is ShotKind.GENERAL

    progress("polish: points")
    sigma = adjustment.sigma
    state = with_all_points(part, adjustment.state, observations, core)
    state = BundleAdjustment(state, observations, replace(o, iterations=4), sigma=sigma, points_only=True).solve()
    if o.observation_sigmas is None:
        observations, tracks, state = _without_outliers(state, observations, tracks, sigma, o)
    else:
        limit = o.observation_sigmas * sigma
        observations, tracks, state = _without_outlying_observations(state, observations, tracks, limit, o)
    progress("polish: all tracks")
    prior = None
    # Pixel errors that repeat themselves, from frame to frame and among neighbours, weigh less; the kernel keeps its
    # width in pixels.
    wide = float(np.sqrt(inflation))
    final = replace(o, kernel=o.kernel / wide)
    if weighed is not None:
        adjustment, prior = joint_problem(state, observations, tracks, used, weighed, sigma * wide, final)
    else:
        adjustment = BundleAdjustment(state, observations, final, sigma=sigma * wide, free_translation=free)
    adjustment.solve(o.final_iterations)
    if prior is not None:
        prior.residual = adjustment.prior_residuals()
    marginals = adjustment.marginals()
    camera_covariance = in_scene_unit(marginals, adjustment.state)
    observability = camera_observability(adjustment, marginals, camera_covariance)
    k = len(frames)
    if prior is not None:
        first = 6 * k + len(state.log_focal)
        affine = np.sqrt(camera_covariance.diagonal()[first : first + 2 * len(prior.images)])
        prior.scale_std, prior.shift_std = affine[::2], affine[1::2]
    result = Polished(
        frames, adjustment.state, tracks, observations, adjustment.reprojection_errors(), sigma,
        motion, pose_blocks(camera_covariance, k), observability,
        marginals.inverse_distance_std(camera_covariance), prior, lens,
    )  # fmt: skip
    result.control_unused = control is not None and not free
    if control is not None and free:
        progress("polish: control")
        _put_under_control(result, adjustment, control)
    if len(frames) < len(registered):
        progress("polish: frames between")
        group = groups[registered]
        if lens is not None and len(lens.lens.focal) > len(focal):
            group, lens = np.arange(len(registered)), _between(lens, frames, np.array(registered))
            solved = np.searchsorted(registered, frames)
            result.state, result.lens = replace(result.state, log_focal=np.log(lens.lens.focal), group=solved), lens
        _add_frames_between(result, images, registered, group, options)
    return result


def _put_under_control(result: Polished, adjustment: BundleAdjustment, control: LocatedControl) -> None:
    """Everything as it is with the control; what carries each camera stays as the images and the prior have it."""
    found = controlled(adjustment, control, result.frames)
    k = len(result.frames)
    result.state, result.errors = found.adjustment.state, found.adjustment.reprojection_errors()
    result.covariance, result.datum, result.control = found.covariance, found.datum, found.fit
    result.point_std = found.marginals.inverse_distance_std(found.camera_covariance)
    if result.prior is not None:
        result.prior.residual = found.adjustment.prior_residuals()
        first = 6 * k + len(result.state.log_focal)
        affine = np.sqrt(found.camera_covariance.diagonal()[first : first + 2 * len(result.prior.images)])
        result.prior.scale_std, result.prior.shift_std = affine[::2], affine[1::2]


def _estimate_lens(
    adjustment: BundleAdjustment, guess: Lens, frames: list[int], options: Options, fallback: Array | None
) -> tuple[BundleAdjustment, LensEstimate]:
    """As `estimate_lens`, with a focal length for every frame where a zoom is asked for and found."""
    zoom = None
    if options.lens == "zoom" and len(guess.focal) == 1:
        zoom = find_zoom(adjustment, guess, np.array(frames, np.float64), options.polish)
    if zoom is None or not zoom.found:
        adjustment, lens = estimate_lens(adjustment, guess, options, fallback=fallback)
        return adjustment, replace(lens, zoom_std=zoom.std if zoom else None)
    zoomed = Lens(np.exp(zoom.adjustment.state.log_focal), guess.shape)
    prior = np.zeros(len(frames)), zoom.information
    adjustment, lens = estimate_lens(zoom.adjustment, zoomed, options, prior)
    seen = Lens(np.repeat(guess.focal, len(frames)), guess.shape)
    return adjustment, replace(lens, guess=seen, zoom_std=zoom.std)


# --- set-up -----------------------------------------------------------------------------------------------------


def _gather(images: list[MappedImage], min_length: int) -> tuple[Observations, Index]:
    """Observations of all tracks that are long enough, sorted by track, and the tracks' ids."""
    ids, count = np.unique(np.concatenate([i.tracks.ids for i in images]), return_counts=True)
    ids = ids[count >= min_length]
    return gather(images, ids), ids


def _first_guess(
    images: list[MappedImage],
    observations: Observations,
    tracks: Index,
    map_points: tuple[Index, Array],
    focal: Array,
    group: Index,
) -> State:
    """Poses in the first camera's frame, points triangulated from a few views, median inverse distance 1."""
    first = images[0]
    rotation, origin = first.pose
    turn = np.array([i.rotation for i in images]) @ rotation.T
    translation = np.array([i.translation for i in images]) - turn @ origin
    ids, points = map_points
    points = points @ rotation.T + origin
    distance = np.linalg.norm(points, axis=1)
    unit = float(np.median(1.0 / np.maximum(distance, 1e-6)))
    translation = translation * unit
    mapped = np.isin(tracks, ids)
    at = np.searchsorted(ids, tracks[mapped])
    bearing, inverse = np.empty((len(tracks), 3)), np.empty(len(tracks))
    bearing[mapped] = points[at] / distance[at, None]
    inverse[mapped] = 1.0 / np.maximum(distance[at] * unit, 1e-3)
    if not mapped.all():
        new = np.nonzero(~mapped)[0]
        cameras = State(turn, translation, bearing[:0], inverse[:0], np.log(focal), group=group)
        result = _triangulated(cameras, observations, new, np.ones(len(new)))
        bearing[new], inverse[new] = result.bearing, result.inverse_distance
    inverse = np.clip(inverse, 0.02, 20.0)
    return State(turn, translation, bearing, inverse, np.log(focal), group=group)


def _triangulated(cameras: State, observations: Observations, points: Index, fallback: Array) -> Triangulation:
    """Some points from a few views each, spread over their tracks; `fallback` as in `triangulate`."""
    o = observations.of(points)
    start = np.searchsorted(o.point, np.arange(len(points)))
    length = np.diff(np.append(start, len(o.point)))[o.point]
    place = np.arange(len(o.point)) - start[o.point]
    spaced = place * _TRIANGULATION_VIEWS // length > (place - 1) * _TRIANGULATION_VIEWS // length
    few = spaced | (place == length - 1)
    return triangulate(
        cameras.rotation,
        cameras.translation,
        Observations(o.frame[few], o.point[few], o.xy[few]),
        focal=float(np.median(cameras.focal)),
        inlier_px=5.0,
        sigma=FIRST_SIGMA_PX,
        fallback=fallback,
    )


# --- stages -----------------------------------------------------------------------------------------------------


def with_all_points(part: State, solved: State, observations: Observations, core: Index) -> State:
    """The cameras and core points of `part`, and the other points triangulated from the cameras as `solved`.

    What the map said of the others is as wrong as the map was, and in another unit.
    """
    count = int(observations.point[-1]) + 1
    bearing, inverse = np.empty((count, 3)), np.empty(count)
    bearing[core], inverse[core] = part.bearing, part.inverse_distance
    others = np.setdiff1d(np.arange(count), core)
    if len(others):
        typical = float(np.median(solved.inverse_distance))
        new = _triangulated(solved, observations, others, np.full(len(others), typical))
        bearing[others], inverse[others] = new.bearing, np.clip(new.inverse_distance, 0.02 * typical, 20.0 * typical)
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
    return observations.of(keep), tracks[keep], state


def _without_outlying_observations(
    state: State, observations: Observations, tracks: Index, limit_px: float, options: PolishOptions
) -> tuple[Observations, Index, State]:
    """Drop wrong matches one by one, and tracks of which less than two observations remain."""
    good = BundleAdjustment(state, observations, options, sigma=1.0).reprojection_errors() < limit_px
    good &= np.bincount(observations.point, good, len(tracks))[observations.point] >= 2
    keep = np.unique(observations.point[good])
    state = replace(state, bearing=state.bearing[keep], inverse_distance=state.inverse_distance[keep])
    o = observations
    return Observations(o.frame[good], o.point[good], o.xy[good]).of(keep), tracks[keep], state


# --- long shots -------------------------------------------------------------------------------------------------


def _solved_frames(images: list[MappedImage], registered: list[int], limit: int) -> list[int]:
    """The frames that are variables of the polish: all, or in a long shot the keyframes and others between them."""
    if len(registered) <= limit:
        return registered
    keyframes = [i for i in registered if images[i].keyframe]
    if len(keyframes) > limit:
        return [keyframes[k] for k in np.linspace(0, len(keyframes) - 1, limit).astype(int)]
    others = [i for i in registered if not images[i].keyframe]
    fill = [others[k] for k in np.linspace(0, len(others) - 1, limit - len(keyframes)).astype(int)]
    return sorted(keyframes + fill)


def _between(lens: LensEstimate, frames: list[int], wanted: Index) -> LensEstimate:
    """Of a zoom that is known at some images, the lens at others."""
    return replace(
        lens,
        guess=Lens(np.repeat(lens.guess.focal[:1], len(wanted)), lens.guess.shape),
        lens=Lens(np.exp(np.interp(wanted, frames, np.log(lens.lens.focal))), lens.lens.shape),
        focal_std=np.interp(wanted, frames, lens.focal_std),
    )


def _add_frames_between(
    result: Polished, images: list[MappedImage], registered: list[int], group: Index, options: Options
) -> None:
    """Register the frames that were left out on the polished points; `group`: of each registered frame."""
    state, m = result.state, options.mapper
    seen = gather([images[f] for f in registered], result.tracks)
    if result.lens is not None:
        seen = result.lens.renormalize(seen, group)
    by_frame = {f: np.nonzero(seen.frame == k)[0] for k, f in enumerate(registered)}
    focal = dict(zip(registered, np.exp(state.log_focal)[group].tolist(), strict=True))
    solved = np.array(result.frames)
    points = state.points
    poses = {f: (state.rotation[k], state.translation[k]) for k, f in enumerate(result.frames)}
    for f in registered:
        if f in poses:
            continue
        mine = by_frame[f]
        if len(mine) < m.min_inliers:
            continue
        near = int(solved[np.argmin(np.abs(solved - f))])
        found = register_image(
            points[seen.point[mine]], seen.xy[mine], *poses[near],
            focal=focal[f], sigma=max(result.sigma, SMALLEST_SIGMA_PX), inlier_px=m.inlier_px,
        )  # fmt: skip
        if found.inliers.sum() >= m.min_inliers:
            poses[f] = found.rotation, found.translation
    frames = sorted(poses)
    row = {f: k for k, f in enumerate(frames)}
    nearest = np.argmin(np.abs(np.array(frames)[:, None] - solved), axis=1)
    result.state = replace(
        state,
        rotation=np.array([poses[f][0] for f in frames]),
        translation=np.array([poses[f][1] for f in frames]),
        group=group[np.isin(registered, frames)],
    )
    result.covariance = result.covariance[nearest]
    result.observability = [result.observability[k] for k in nearest]
    if result.prior is not None:
        new_row = np.array([row[f] for f in result.frames])
        p = result.prior
        p.images = new_row[p.images]
        p.observations = replace(p.observations, frame=new_row[p.observations.frame])
    result.frames = frames
    kept = np.isin(np.array(registered)[seen.frame], frames)
    rows = np.searchsorted(frames, np.array(registered)[seen.frame[kept]])
    result.observations = Observations(rows, seen.point[kept], seen.xy[kept])
    result.errors = BundleAdjustment(
        result.state, result.observations, options.polish, sigma=result.sigma
    ).reprojection_errors()
