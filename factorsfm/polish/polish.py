"""From the incremental map to the final result: all frames and all tracks, with the prior at the weight it earns."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.marginals import in_scene_unit
from factorsfm.adjustment.noise import SMALLEST_SIGMA_PX, coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import PriorPart, joint_problem
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.residuals import cauchy
from factorsfm.adjustment.state import State
from factorsfm.adjustment.track_errors import TrackErrors, measure_track_errors
from factorsfm.control.fit import ControlFit
from factorsfm.control.known import LocatedControl
from factorsfm.control.solve import frames_under_control, solve_under_control
from factorsfm.lens.lens import Lens, LensEstimate
from factorsfm.lens.rolling_shutter import Recording, Shutter, seen_at_once, with_sweep
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.registration import register_image
from factorsfm.motion.shot_kind import Motion
from factorsfm.polish.connected_frames import connected_frames
from factorsfm.polish.observability import CameraObservability, camera_observability, pose_blocks
from factorsfm.polish.start import polish_start
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.similarity import Similarity
from factorsfm.support.status import ShotKind
from factorsfm.tracks.image_tracks import seen_by

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_FIRST_ITERATIONS = 2  # over all tracks, until their errors are measured


@dataclass(slots=True)
class Polished:
    """Result of the polish; the first of its cameras is the world, the median inverse distance is about 1.

    Attributes:
        frames: (k,) positions of the images in `state`; tracks: (n,) track of each point.
        errors: (m,) reprojection errors of `observations` (pixels); sigma: their standard deviation.
        covariance: (k, 6, 6) of the poses, GTSAM's convention, `in_scene_unit`.
        observability: what carries each of them.
        point_std: (n,) standard deviations of the inverse distances, in the same unit.
        left_out: why, of the registered images that have no pose here.
        lens: what became of an unknown lens, None where it is known.
        shutter: a rolling shutter, None where the shot shows none; recorded: whether poses and observations are those
            of the recorded images all the same, see `Options.shutter`.
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
    left_out: dict[int, str]
    prior: PriorPart | None = None
    lens: LensEstimate | None = None
    shutter: Shutter | None = None
    recorded: bool = False
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
    first_focal: tuple[Array, float] | None = None,
    recording: Recording | None = None,
) -> Polished:
    """Triangulate all tracks and minimise over all registered frames.

    A frame of which hardly any track is left among those that fit the cameras is held by nothing: all is done again
    without it.

    Args:
        images: at least one registered; map_points: track ids and positions of the incremental map.
        focal: (g,) focal lengths, pixels; first guesses where the options refine them.
        shape: (4,) distortion of the lens as in `factors.distort` where the options refine the lens; None is none.
        groups: (images,) which of the focal lengths is that of each image; None: all have the first.
        first_focal: what was thought of the focal lengths first, as in `estimate_lens`; None: `focal`.
        recording: of which the images are all, if their rows may have been read one after another; None: all at once,
            or in no order of time.
        control: what is known beforehand, its marks normalised as the tracks are; it takes part at the end, and only
            where the camera moves.

    Raises:
        ReconstructionError: hardly any tracks are left that join frames, or what is known of the registered frames
            leaves open where the world of the control is.
    """
    o, least = options.polish, options.mapper.min_inliers
    registered = [i for i, image in enumerate(images) if image.registered]
    groups = np.zeros(len(images), np.int64) if groups is None else groups
    guess = Lens(focal) if shape is None else Lens(focal, np.r_[shape, np.zeros(2)])
    left_out: dict[int, str] = {}
    while True:
        frames = _solved_frames(images, registered, o.max_frames)
        if control is not None:
            frames = sorted({*frames, *frames_under_control(registered, control, o.max_frames // 2)})
        used = [images[i] for i in frames]
        observations, tracks = _gather(used, min(o.min_track_length, max(2, len(used))))
        unheld = _unheld(observations, frames, least)
        if not unheld:
            group = groups[frames]
            if recording is not None:
                observations = with_sweep(observations, tracks, images, frames, guess, group, recording)
            known = polish_start(
                used, observations, tracks, map_points, guess, group, frames, options, first_focal, progress
            )
            unheld = _unheld(known.observations, frames, least)
        if not unheld:
            break
        logger.info("left out of the polish, too few tracks: images %s", sorted(unheld))
        left_out.update(unheld)
        registered = [i for i in registered if i not in left_out]
        if len(registered) < 2:
            raise ReconstructionError(
                f"{len(registered)} of {len(images)} frames have enough tracks that agree with those of other frames, "
                "at least 2 needed"
            )
    observations, tracks, sigma, lens = known.observations, known.tracks, known.sigma, known.lens
    if control is not None and lens is not None:
        zooms = len(lens.lens.focal) > len(focal)
        whole, of_image = (
            (_between(lens, frames, np.arange(len(images))), np.arange(len(images))) if zooms else (lens, groups)
        )
        control = replace(control, marks=whole.renormalize(control.marks, of_image))
    free, state = known.motion.kind is ShotKind.GENERAL, known.state.seen_from(0)

    progress("polish: all tracks")
    prior = None
    scale, wide, errors = sigma, float(np.sqrt(known.inflation)), None
    if o.observation_sigmas is None:
        state, errors = _with_track_errors(state, observations, sigma, free, o)
        scale = errors.sigma
    # Pixel errors that repeat themselves, from frame to frame and among neighbours, weigh less; the kernel keeps its
    # width in pixels. What a track repeats is counted twice so: what neighbours repeat lasts longer than a stretch.
    final = replace(o, kernel=o.kernel / wide)
    if known.prior is not None:
        adjustment, prior = joint_problem(
            state,
            observations,
            tracks,
            [image.tracks for image in used],
            known.prior,
            scale * wide,
            final,
            track_errors=errors,
        )
    else:
        adjustment = BundleAdjustment(
            state, observations, final, ErrorModel(scale * wide, errors), free=Free(translation=free)
        )
    adjustment.solve(o.final_iterations)
    marginals = adjustment.marginals()
    camera_covariance = in_scene_unit(marginals, adjustment.state)
    observability = camera_observability(adjustment, marginals, camera_covariance)
    k = len(frames)
    if prior is not None:
        _describe_affines(prior, adjustment, camera_covariance)
    result = Polished(
        frames, adjustment.state, tracks, observations, adjustment.reprojection_errors(), sigma,
        known.motion, pose_blocks(camera_covariance, k), observability,
        marginals.inverse_distance_std(camera_covariance), left_out, prior, lens, known.shutter,
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
        _add_frames_between(result, images, registered, group, options, recording)
    if result.shutter is not None and options.shutter == "auto":
        _fit_to_recorded_images(result, result.shutter, o)
    return result


def _with_track_errors(
    state: State, observations: Observations, sigma: float, free: bool, options: PolishOptions
) -> tuple[State, TrackErrors]:
    """The tracks without the prior, and how far their errors persist, which shows where the cameras fit them all."""
    adjustment = BundleAdjustment(state, observations, options, ErrorModel(sigma), free=Free(translation=free))
    adjustment.solve(_FIRST_ITERATIONS)
    return adjustment.state, measure_track_errors(adjustment.reprojection_vectors(), observations, options.kernel)


def _unheld(observations: Observations, frames: list[int], least: int) -> dict[int, str]:
    """The images (of these, in the order of the observations) that too few observations join to the others, and why."""
    joined, seen = connected_frames(observations, len(frames), least)
    return {frames[row]: _too_few(int(seen[row]), least) for row in np.nonzero(~joined)[0].tolist()}


def _too_few(count: int, least: int) -> str:
    return f"{count} of {least} needed tracks agree with those of the other frames in the polish"


def _put_under_control(result: Polished, adjustment: BundleAdjustment, control: LocatedControl) -> None:
    """Everything as it is with the control; what carries each camera stays as the images and the prior have it."""
    found = solve_under_control(adjustment, control, result.frames)
    result.state, result.errors = found.adjustment.state, found.adjustment.reprojection_errors()
    result.covariance, result.datum, result.control = found.covariance, found.datum, found.fit
    result.point_std = found.marginals.inverse_distance_std(found.camera_covariance)
    if result.prior is not None:
        _describe_affines(result.prior, found.adjustment, found.camera_covariance)


def _describe_affines(prior: PriorPart, adjustment: BundleAdjustment, camera_covariance: Array) -> None:
    """What a solution says of the prior: its residuals, and how certain scale and shift of each image are."""
    std = np.sqrt(camera_covariance.diagonal())
    prior.residual = adjustment.prior_residuals()
    prior.scale_std, prior.shift_std = std[adjustment.columns.scales], std[adjustment.columns.shifts]


def _fit_to_recorded_images(result: Polished, shutter: Shutter, options: PolishOptions) -> None:
    """What agrees with the rolling shutter, seen by cameras without one."""
    recorded = shutter.recorded(result.observations, result.state)
    weight = cauchy(result.errors[:, None] / result.sigma, options.kernel)[1]
    moves = result.motion.kind is ShotKind.GENERAL
    result.state = replace(seen_at_once(result.state, recorded, weight, moves=moves), world=-1).seen_from(0)
    result.observations, result.recorded = recorded, True
    result.errors = BundleAdjustment(result.state, recorded, options, ErrorModel(result.sigma)).reprojection_errors()
    result.sigma = coordinate_sigma(result.errors)


def _gather(images: list[MappedImage], min_length: int) -> tuple[Observations, Index]:
    """Observations of all tracks that are long enough, sorted by track, and the tracks' ids."""
    tracks = [image.tracks for image in images]
    ids = seen_by(tracks, min_length)
    return gather(tracks, ids), ids


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
    result: Polished,
    images: list[MappedImage],
    registered: list[int],
    group: Index,
    options: Options,
    recording: Recording | None,
) -> None:
    """Register the frames that were left out on the polished points; `group`: of each registered frame."""
    state, m = result.state, options.mapper
    seen = gather([images[f].tracks for f in registered], result.tracks)
    if (change := result.lens or result.shutter) is not None:
        if result.shutter is not None and recording is not None:
            seen = with_sweep(seen, result.tracks, images, registered, change.guess, group, recording)
        seen = change.renormalize(seen, group)
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
            result.left_out[f] = _too_few(len(mine), m.min_inliers)
            continue
        near = int(solved[np.argmin(np.abs(solved - f))])
        found = register_image(
            points[seen.point[mine]], seen.xy[mine], *poses[near],
            focal=focal[f], sigma=max(result.sigma, SMALLEST_SIGMA_PX), inlier_px=m.inlier_px,
        )  # fmt: skip
        if found.inliers.sum() >= m.min_inliers:
            poses[f] = found.rotation, found.translation
        else:
            result.left_out[f] = (
                f"{found.inliers.sum()} of {m.min_inliers} needed inliers among {len(mine)} tracks of the polish"
            )
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
    result.observations = seen.at(kept, frame=rows)
    result.errors = BundleAdjustment(
        result.state, result.observations, options.polish, ErrorModel(result.sigma)
    ).reprojection_errors()
