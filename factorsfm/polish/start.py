"""Where the polish starts: cameras on the longest tracks, lens, weight of the prior, and the tracks that fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import FocalPrior, Free
from factorsfm.adjustment.some_frames import seen_in, some_frames
from factorsfm.adjustment.state import State
from factorsfm.lens.estimate import estimate_lens
from factorsfm.lens.lens import Lens, LensEstimate, observed_width, shape_sigmas, through
from factorsfm.lens.rolling_shutter import Shutter, find_shutter
from factorsfm.lens.search import FoundLens, found_lens
from factorsfm.lens.zoom import Zoom, find_zoom, unannounced_zoom
from factorsfm.mapping.all_points import triangulated, with_all_points
from factorsfm.motion.at_rest import Rest
from factorsfm.motion.moving import center_and_spread, log_errors, moving_together
from factorsfm.motion.readings import Reading, solution_from
from factorsfm.motion.shot_kind import Motion, classify_motion
from factorsfm.motion.suspects import agreeing
from factorsfm.polish.camera_starts import best_solution, core_tracks, is_doubtful, on_what_fits
from factorsfm.polish.core_frames import core_frames, in_all_frames
from factorsfm.polish.near_and_far import NearAndFar, near_and_far
from factorsfm.polish.shot import Shot
from factorsfm.polish.simple_readings import turning_reading, unless_at_rest
from factorsfm.polish.stuck_frames import freed
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MANY_TRACKS = 0.3  # of the largest number of tracks in a frame


@dataclass(frozen=True, slots=True)
class PolishStart:
    """Where the last adjustment starts.

    Attributes:
        state: of cameras, lens and points; observations, tracks: that belong together.
        sigma: of the core tracks, pixels; inflation: of its square, since errors repeat themselves.
        depths: with the prior at the weight it earns; core: solved first.
        moving: see `Polished`.
    """

    state: State
    observations: Observations
    tracks: Index
    sigma: float
    inflation: float
    depths: NearAndFar
    core: Core
    moving: Index


@dataclass(frozen=True, slots=True)
class Core:
    """The cameras solved on the core tracks.

    Attributes:
        points: rows of the core among all points; adjustment: converged over them.
        left_out: rows of the points without which it is.
        turns, rest, rival, zoom: see `Polished`.
    """

    points: Index
    left_out: Index
    adjustment: BundleAdjustment
    motion: Motion
    lens: LensEstimate | None
    shutter: Shutter | None
    turns: bool
    rest: Rest | None
    rival: float
    zoom: float


def polish_start(
    shot: Shot,
    frames: list[int],
    observations: Observations,
    tracks: Index,
    options: Options,
    progress: Callable[[str], None],
) -> PolishStart:
    """The cameras on the longest tracks, lens, motion and the weight of the prior, and all tracks that fit.

    Args:
        frames: positions of the registered images; observations, tracks: theirs.
    """
    progress("polish: cameras")
    core = _core(shot, frames, observations, tracks, options)
    inflation, general = core.adjustment.error_inflation(), core.motion.kind is ShotKind.GENERAL
    depths = NearAndFar(core.adjustment)
    if general:
        depths = near_and_far(core.adjustment, tracks[core.points], shot.tracks(frames), inflation, options)
        core = replace(core, adjustment=depths.adjustment)

    progress("polish: points")
    part = core.adjustment.state if general else core.motion.rotation_only
    state, observations, tracks, moving = _with_fitting_tracks(part, core, observations, tracks, shot, options.polish)
    return PolishStart(state, observations, tracks, core.adjustment.sigma, inflation, depths, core, moving)


def _core(shot: Shot, frames: list[int], observations: Observations, tracks: Index, options: Options) -> Core:
    """Cameras, lens and shutter on the longest tracks; of a long shot on few of the frames first."""
    rows = np.arange(len(frames))
    if shot.in_time and options.lens != "zoom":  # between two frames, a zoom may change its speed
        alone = not options.estimates_lens and observations.sweep is None
        rows = core_frames(observations, len(frames), alone=alone)
    if len(rows) < len(frames):
        few, points = seen_in(rows, observations)
        core = _solved_core(shot, [frames[row] for row in rows], few, tracks[points], options)
        if core.lens is None or not core.lens.zooms:
            core = replace(core, points=points[core.points], left_out=points[core.left_out])
            return _in_all_frames(core, rows, shot, frames, observations, options)
    return _solved_core(shot, frames, observations, tracks, options)


def _in_all_frames(
    core: Core, rows: Index, shot: Shot, frames: list[int], observations: Observations, options: Options
) -> Core:
    """The core of some frames with all of them; `rows`: of its frames."""
    adjustment, seen = core.adjustment, observations.of(core.points)

    def all_frames(state: State, *, moves: bool) -> State:
        return in_all_frames(
            state, rows, seen, shot.group[frames], shot.turns(frames),
            moves=moves, sigma=adjustment.sigma, options=shot.registering(options.mapper),
        )  # fmt: skip

    state = all_frames(adjustment.state, moves=True)
    motion = replace(core.motion, rotation_only=all_frames(core.motion.rotation_only, moves=False))
    return replace(core, adjustment=BundleAdjustment(state, seen, options.polish, adjustment.errors), motion=motion)


def _solved_core(shot: Shot, frames: list[int], observations: Observations, tracks: Index, options: Options) -> Core:
    """Cameras, lens and shutter on the longest tracks."""
    o = options.polish
    trusted = shot.trusted(tracks)
    core = trusted[core_tracks(observations.of(trusted), len(frames))]
    whole = observations.of(core)
    first = guess = _first_guess(shot, frames, whole, tracks[core], _world(observations))
    search, solved = None, shot.solved_lens
    if solved is not None:
        search = FoundLens(Lens.of(first), Lens(solved.focal), better=True, bent=solved if solved.bends else None)
        guess = replace(through(guess, solved.focal), lens=solved.shape)
    found = turning_reading(guess, whole, options, lens_solved=solved is not None)
    if found is None:
        if search is None and options.refine_focal_length and options.lens != "zoom":
            search = _searched(guess, whole, options)
            guess = through(guess, search.straight.focal) if search.better else guess
        found = unless_at_rest(best_solution(guess, whole, options), guess, whole, options)

    def zoom_beside(fixed: BundleAdjustment) -> Zoom | None:
        """A zoom that nobody announced, beside a solution with one focal length."""
        reading, doubtful = Reading(found.kept, fixed), is_doubtful(fixed, options)
        return unannounced_zoom(first, whole, reading, shot.times(frames), o, doubtful=doubtful)

    adjustment = freed(found.adjustment, np.array(frames), options) if shot.in_time else found.adjustment
    few = adjustment.observations
    motion, lens, shutter, zoom = None, None, None, None
    if few.sweep is not None:
        motion = _motion(adjustment, found.rest, o)
        shutter = find_shutter(adjustment, motion, options)
    at_once = adjustment
    if shutter is not None:
        adjustment = solution_from(replace(adjustment.state, lens=shutter.lens.shape), few, options.polish)
    if options.estimates_lens:
        moves = not found.turns
        adjustment, lens, zoom = _estimate_lens(adjustment, shot, frames, options, search, zoom_beside, moves=moves)
        if shutter is not None and (shutter := shutter.known_with(lens)) is None:
            adjustment, lens, zoom = _estimate_lens(at_once, shot, frames, options, search, zoom_beside, moves=moves)
    elif shot.in_time:
        zoom = zoom_beside(adjustment)
    if motion is None or lens is not None or shutter is not None:
        motion = _motion(adjustment, found.rest, o)
    # A zoom that nobody announced is solved on all tracks: some of them may have seemed to move by themselves.
    kept = found.kept if lens is None or lens.announced else np.arange(len(core))
    return Core(
        core[kept], np.delete(core, kept), adjustment, motion, lens, shutter, found.turns, found.rest, found.rival,
        0.0 if zoom is None else zoom.ratio,
    )  # fmt: skip


def _motion(adjustment: BundleAdjustment, rest: Rest | None, options: PolishOptions) -> Motion:
    """As `classify_motion`; what rests before a fixed camera may drift in the tracker, but is no sign of a motion."""
    motion = classify_motion(adjustment, options)
    return replace(motion, kind=ShotKind.STATIC) if rest is not None and rest.fixed else motion


def _first_guess(shot: Shot, frames: list[int], observations: Observations, tracks: Index, world: int) -> State:
    """Poses in the frame of one of the cameras, points triangulated from a few views, median inverse distance 1."""
    images = [shot.images[position] for position in frames]
    rotation, origin = images[world].pose
    turn = np.array([i.rotation for i in images]) @ rotation.T
    translation = np.array([i.translation for i in images]) - turn @ origin
    ids, points = shot.map_points
    points = points @ rotation.T + origin
    distance = np.linalg.norm(points, axis=1)
    unit = float(np.median(1.0 / np.maximum(distance, 1e-6)))
    mapped = np.isin(tracks, ids)
    at = np.searchsorted(ids, tracks[mapped])
    bearing, inverse = np.empty((len(tracks), 3)), np.empty(len(tracks))
    bearing[mapped] = points[at] / distance[at, None]
    inverse[mapped] = 1.0 / np.maximum(distance[at] * unit, 1e-3)
    cameras = State(
        turn, translation * unit, bearing, inverse, np.log(shot.guess.focal),
        lens=shot.guess.shape, group=shot.group[frames], world=world,
    )  # fmt: skip
    if not mapped.all():
        new = np.nonzero(~mapped)[0]
        result = triangulated(cameras, observations, new, np.ones(len(new)))
        bearing[new], inverse[new] = result.bearing, result.inverse_distance
    return replace(cameras, bearing=bearing, inverse_distance=np.clip(inverse, 0.02, 20.0))


def _world(observations: Observations) -> int:
    """The first frame with many tracks: as the origin of the world, it makes the way to the solution short."""
    count = np.bincount(observations.frame)
    return int(np.argmax(count >= _MANY_TRACKS * count.max()))


def _searched(guess: State, observations: Observations, options: Options) -> FoundLens:
    """The lenses that few frames show, without what moves by itself there."""
    solved = on_what_fits(*some_frames(guess, observations)[1:], options).adjustment
    width = observed_width(solved.state, solved.observations)
    return found_lens(solved, options.polish, np.r_[shape_sigmas(options.lens, width), np.zeros(2)])


def _estimate_lens(
    adjustment: BundleAdjustment,
    shot: Shot,
    frames: list[int],
    options: Options,
    search: FoundLens | None,
    zoom_beside: Callable[[BundleAdjustment], Zoom | None],
    *,
    moves: bool,
) -> tuple[BundleAdjustment, LensEstimate, Zoom | None]:
    """As `estimate_lens`, with a focal length for every frame where there is a zoom; and one that is only suspected."""
    zoom, suspected = None, None
    if options.lens == "zoom" and len(adjustment.state.log_focal) == 1:
        zoom = find_zoom(adjustment, shot.times(frames), options.polish)
    if zoom is None or not zoom.found:
        first = shot.first_focal or (shot.guess.focal, 0.0)
        fixed, lens = estimate_lens(adjustment, options, first_focal=first, search=search, moves=moves)
        alone = options.lens == "distortion" and shot.in_time and len(adjustment.state.log_focal) == 1
        if alone and (moves or is_doubtful(fixed, options)):
            suspected = zoom_beside(fixed)
        if suspected is None or not suspected.certain:
            return fixed, replace(lens, zoom_std=zoom.std if zoom else None), suspected
        zoom = suspected
    prior = FocalPrior(np.zeros(len(frames)), zoom.information)
    adjustment, lens = estimate_lens(zoom.adjustment, options, prior)
    return adjustment, replace(lens, zoom_std=zoom.std, announced=suspected is None), None


# --- all tracks -------------------------------------------------------------------------------------------------


def _with_fitting_tracks(
    part: State, core: Core, observations: Observations, tracks: Index, shot: Shot, options: PolishOptions
) -> tuple[State, Observations, Index, Index]:
    """All points for the cameras of `part`, and the tracks that fit them; of the suspects those that agree, and all
    that are supervised.

    The last of the result are the tracks that move by themselves.
    """
    solved, points, left_out = core.adjustment, core.points, core.left_out
    with_ray = np.asarray(np.isfinite(solved.state.normalized(observations)).all(axis=1))
    if not with_ray.all():
        observations, kept = _only(observations, with_ray)
        tracks, points = tracks[kept], np.searchsorted(kept, points)
        left_out = np.flatnonzero(np.isin(kept, left_out))
    state = with_all_points(part, solved.state, observations, points)
    adjustment = BundleAdjustment(
        state, observations, replace(options, iterations=4), solved.errors, free=Free(cameras=False)
    )
    state, errors = adjustment.solve(), adjustment.reprojection_errors()
    agree = agreeing(observations, errors, np.isin(tracks, shot.suspects))
    left_out = np.union1d(left_out, np.flatnonzero(~agree))
    supervised = np.isin(tracks, shot.supervised.ids)
    judged, moves = np.flatnonzero(~supervised), np.zeros(len(tracks), bool)
    rests_on = np.flatnonzero(np.isin(judged, points))
    if len(rests_on):
        moves[judged] = moving_together(
            observations.of(judged), errors[~supervised[observations.point]], solved.sigma,
            rests_on=rests_on, left_out=np.flatnonzero(np.isin(judged, left_out)),
        )  # fmt: skip
    scene, moving = agree & ~moves, tracks[moves]
    if not scene.all():
        kept = np.flatnonzero(scene)
        state, tracks, errors = state.of(kept), tracks[kept], errors[scene[observations.point]]
        supervised = supervised[kept]
        observations = observations.of(kept)
    if supervised.all():
        return state, observations, tracks, moving
    if options.observation_sigmas is None:
        kept = np.flatnonzero(_usual_points(observations, errors, ~supervised, options) | supervised)
        return state.of(kept), observations.of(kept), tracks[kept], moving
    observations, kept = _only(observations, errors < options.observation_sigmas * solved.sigma)
    return state.of(kept), observations, tracks[kept], moving


def _usual_points(
    observations: Observations, errors: Array, among: NDArray[np.bool_], options: PolishOptions
) -> NDArray[np.bool_]:
    """(n,) whether the typical error of a point is not far outside what is usual among some (log scale, robust)."""
    typical = log_errors(observations, errors)
    center, spread = center_and_spread(typical[among])
    return np.asarray(typical < center + options.outlier_sigmas * max(spread, 0.1))


def _only(observations: Observations, good: NDArray[np.bool_]) -> tuple[Observations, Index]:
    """The good observations of the points of which at least two are good, and these points."""
    good = good & (np.bincount(observations.point, good)[observations.point] >= 2)
    kept = np.unique(observations.point[good])
    return observations.at(good).of(kept), kept
