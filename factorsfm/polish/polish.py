"""From the incremental map to the final result: all frames and all tracks, with the prior at its measured weight."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import pose_covariances
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import PriorPart, joint_problem
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.residuals import cauchy
from factorsfm.adjustment.shared_errors import in_scene_unit_with, shared_errors
from factorsfm.adjustment.state import State
from factorsfm.adjustment.track_errors import TrackErrors, measure_track_errors
from factorsfm.control.located import LocatedControl
from factorsfm.control.solve import Controlled, frames_under_control, solve_under_control
from factorsfm.control.with_factors import ShotFactors, solve_with_factors
from factorsfm.lens.rolling_shutter import seen_at_once
from factorsfm.motion.stretches import Stretch, stretches
from factorsfm.polish.connected_frames import connected_frames
from factorsfm.polish.frames_between import add_frames_between, solved_frames, too_few_tracks
from factorsfm.polish.observability import camera_observability
from factorsfm.polish.polished import Polished
from factorsfm.polish.shot import Shot
from factorsfm.polish.start import Core, PolishStart, polish_start
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import ShotKind
from factorsfm.tracks.supervised import LEAST_SUPERVISED

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_TOLERANCE = 1e-5  # of the last solution; with ten times as much, poses stay a tenth of a standard deviation away
_FIRST_ITERATIONS = 2  # over all tracks, until their errors are measured


def polish(
    shot: Shot,
    options: Options,
    progress: Callable[[str], None] = lambda stage: None,
    *,
    control: LocatedControl | None = None,
    factors: ShotFactors | None = None,
    joining: Callable[[Polished], ShotFactors | None] | None = None,
) -> Polished:
    """Triangulate all tracks and minimise over all registered frames.

    Args:
        control: known poses, points and lengths; it takes part at the end, and only where the camera moves.
        factors: of the caller, where there is no control; they take part as it does.
        joining: gives factors by the poses that images and prior alone show, where there are none before.

    Raises:
        ReconstructionError: hardly any tracks are left that connect frames, or the control does not determine where its
            world is.
    """
    start, frames, left_out = _start(shot, options, progress, control, factors)
    progress("polish: all tracks")
    adjustment, result = _solved(shot, start, frames, left_out, options.polish)
    moves = start.core.motion.kind is ShotKind.GENERAL
    if control is not None and moves:
        progress("polish: control")
        _put_under_control(result, adjustment, control, shot)
    if joining is not None and moves:
        factors = joining(result)
    if factors is not None and moves:
        progress("polish: factors")
        _respect_factors(result, adjustment, factors, shot)
    if result.control is None and (control is not None or factors is not None):
        result.unused = "Control" if control is not None else "Factors added"
    registered = [position for position in shot.registered if position not in left_out]
    if len(frames) < len(registered):
        progress("polish: frames between")
        add_frames_between(result, shot, registered, options)
    if result.shutter is not None and options.shutter == "auto":
        _fit_to_recorded_images(result, options.polish)
    return result


# --- the frames that are solved ---------------------------------------------------------------------------------


def _start(
    shot: Shot,
    options: Options,
    progress: Callable[[str], None],
    control: LocatedControl | None,
    factors: ShotFactors | None,
) -> tuple[PolishStart, list[int], dict[int, str]]:
    """Where the solution starts, the positions of its frames, and why others are left out.

    A frame of which hardly any track is left among those that fit the cameras is not determined: all is done again
    without it.
    """
    o, least = options.polish, options.mapper.min_inliers
    left_out: dict[int, str] = {}
    while True:
        registered = [position for position in shot.registered if position not in left_out]
        if left_out and len(registered) < 2:
            raise ReconstructionError(
                f"{len(registered)} of {len(shot.images)} frames have enough tracks that agree with those of other "
                "frames, at least 2 needed"
            )
        frames = solved_frames(shot.images, registered, o.max_frames)
        frames = sorted({*frames, *_named(registered, control, factors, o.max_frames // 2)})
        tracks = shot.long_tracks(frames, min(o.min_track_length, max(2, len(frames))))
        observations = shot.observations(frames, tracks)
        trusted = shot.trusted(tracks)
        unconnected = _unconnected(shot, observations.of(trusted), tracks[trusted], frames, least)
        if not unconnected:
            start = polish_start(shot, frames, shot.swept(observations, frames, tracks), tracks, options, progress)
            unconnected = _unconnected(shot, start.observations, start.tracks, frames, least)
        if not unconnected:
            return start, frames, left_out
        logger.info("left out of the polish, too few tracks: images %s", sorted(unconnected))
        left_out.update(unconnected)


def _named(registered: list[int], control: LocatedControl | None, factors: ShotFactors | None, limit: int) -> list[int]:
    """Which registered frames must be solved for, since control or factors name them; of very many, some."""
    if control is not None:
        return frames_under_control(registered, control, limit)
    names = factors.frames if factors is not None else []
    if len(names) > limit:
        names = [names[k] for k in np.linspace(0, len(names) - 1, limit).astype(int)]
    return sorted({*names} & {*registered})


def _unconnected(
    shot: Shot, observations: Observations, tracks: Index, frames: list[int], least: int
) -> dict[int, str]:
    """The images (of these, in the order of the observations) that too few of the tracks join to the others, and why.

    A few supervised tracks are enough.
    """
    supervised, count = np.isin(tracks, shot.supervised.ids), -(-least // LEAST_SUPERVISED)
    joined, seen = connected_frames(observations, len(frames), least, np.where(supervised, count, 1))
    counted = f"; a supervised one counts for {count}" if supervised.any() else ""
    return {frames[row]: too_few_tracks(int(seen[row]), least) + counted for row in np.nonzero(~joined)[0].tolist()}


# --- the solution -----------------------------------------------------------------------------------------------


def _solved(
    shot: Shot, start: PolishStart, frames: list[int], left_out: dict[int, str], options: PolishOptions
) -> tuple[BundleAdjustment, Polished]:
    """The adjustment over all tracks, converged, and the result."""
    adjustment, prior = _problem(shot, start, frames, options)
    adjustment.solve(options.final_iterations)
    marginals = adjustment.marginals()
    shared = shared_errors(adjustment, marginals)
    covariance, point_std = in_scene_unit_with(shared, marginals, adjustment.state)
    result = Polished(
        frames, adjustment.state, start.tracks, start.observations, adjustment.reprojection_errors(), start.sigma,
        *adjustment.observation_sigmas(), start.core.motion, *_pose_covariances(covariance, adjustment.state),
        camera_observability(adjustment, marginals, covariance), point_std,
        left_out, prior, start.core.lens, start.core.shutter, moving=start.moving, turns=start.core.turns,
        rest=start.core.rest, rival=start.core.rival, zoom=start.core.zoom,
        inflation=start.inflation, shared_error=start.core.adjustment.shared_error(),
        contradiction=start.depths.correlation,
    )  # fmt: skip
    if shot.seconds is not None:
        result.stretches = _stretches(start.core, frames, shot.seconds[frames], options)
    result.describe_prior(adjustment, covariance)
    return adjustment, result


def _stretches(core: Core, frames: list[int], seconds: Array, options: PolishOptions) -> tuple[Stretch, ...]:
    """What the camera does when, by positions of the images."""
    found = stretches(core.adjustment, core.motion, seconds, options)
    ends = [frames[s.first] - 1 for s in found[1:]] + [frames[-1]]
    return tuple(Stretch(frames[s.first], end, s.kind) for s, end in zip(found, ends, strict=True))


def _pose_covariances(covariance: Array, state: State) -> tuple[Array, Array]:
    """As `pose_covariances`, from the covariance of the camera side."""
    rows = np.arange(len(state.rotation))
    return pose_covariances(covariance, np.tile(np.eye(6), (len(rows), 1, 1)), Columns.of(state).pose(rows), state)


def _problem(
    shot: Shot, start: PolishStart, frames: list[int], options: PolishOptions
) -> tuple[BundleAdjustment, PriorPart | None]:
    """All tracks, with the prior where it takes part."""
    moves, state = start.core.motion.kind is ShotKind.GENERAL, start.state.seen_from(0)
    scale, wide, errors = start.sigma, float(np.sqrt(start.inflation)), None
    if options.observation_sigmas is None:
        state, errors = _with_track_errors(state, start, shot.supervised.sigma_of(start.tracks), moves, options)
        scale = errors.sigma
    # Correlated errors, from frame to frame and among neighbours, weigh less; the kernel keeps its width in pixels. The
    # persistent part of a track is counted twice by that: correlations among neighbours last longer than a stretch.
    model, options = (
        ErrorModel(scale * wide, errors),
        replace(options, kernel=options.kernel / wide, tolerance=_TOLERANCE),
    )
    if start.depths.prior is None:
        return BundleAdjustment(state, start.observations, options, model, free=Free(translation=moves)), None
    return joint_problem(
        state, start.observations, start.tracks, shot.tracks(frames), start.depths.prior, model, options
    )  # fmt: skip


def _with_track_errors(
    state: State, start: PolishStart, known_sigma: Array, moves: bool, options: PolishOptions
) -> tuple[State, TrackErrors]:
    """The state on the tracks alone, and the model of their errors, measured on these residuals where unknown."""
    adjustment = BundleAdjustment(
        state, start.observations, options, ErrorModel(start.sigma), free=Free(translation=moves)
    )
    adjustment.solve(_FIRST_ITERATIONS)
    return adjustment.state, measure_track_errors(
        adjustment.reprojection_vectors(), start.observations, options.kernel, known_sigma
    )  # fmt: skip


# --- what follows -----------------------------------------------------------------------------------------------


def _put_under_control(result: Polished, adjustment: BundleAdjustment, control: LocatedControl, shot: Shot) -> None:
    """Everything as it is with the control; the observability stays that of images and prior."""
    marks = shot.marks(control.marks, result.frames, len(control.control.points))
    _take_over(result, solve_under_control(adjustment, control, marks, result.frames))


def _respect_factors(result: Polished, adjustment: BundleAdjustment, factors: ShotFactors, shot: Shot) -> None:
    """Everything as it is with the factors; the observability stays that of images and prior."""
    marks = shot.observations(result.frames, factors.tracks)
    guided = [] if result.prior is None else [result.frames[row] for row in result.prior.images]
    _take_over(result, solve_with_factors(adjustment, factors, marks, result.frames, guided))
    result.factors = factors


def _take_over(result: Polished, found: Controlled) -> None:
    result.state, result.errors = found.adjustment.state, found.adjustment.reprojection_errors()
    result.covariance, result.relative_covariance = found.covariance, found.relative_covariance
    result.world_alignment, result.control = found.world_alignment, found.fit
    result.point_std = found.point_std
    result.describe_prior(found.adjustment, found.camera_covariance)


def _fit_to_recorded_images(result: Polished, options: PolishOptions) -> None:
    """Cameras without a rolling shutter that show the points most nearly where the recorded images do."""
    weight = cauchy(result.errors[:, None] / result.sigma, options.kernel)[1]
    moves, model = result.motion.kind is ShotKind.GENERAL, ErrorModel(result.sigma)
    rolling = BundleAdjustment(result.state, result.observations, options, model).reprojection_vectors()
    result.shutter_error = float(np.median(result.errors))
    state = replace(seen_at_once(result.state, result.observations, weight, moves=moves), world=-1)
    result.state, result.recorded = state.seen_from(0), True
    at_once = BundleAdjustment(result.state, result.observations, options, model)
    result.rolled, result.errors = rolling - at_once.reprojection_vectors(), at_once.reprojection_errors()
    result.sigma = coordinate_sigma(result.errors)
