"""Where the polish starts: cameras on the longest tracks, lens, weight of the prior, and the tracks that fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import FIRST_SIGMA_PX, block_inflation
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import WeighedPrior, weigh_prior
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free
from factorsfm.adjustment.state import State
from factorsfm.lens.estimate import estimate_lens
from factorsfm.lens.lens import Lens, LensEstimate
from factorsfm.lens.rolling_shutter import Shutter, find_shutter
from factorsfm.lens.zoom import find_zoom
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.triangulation import Triangulation, triangulate
from factorsfm.motion.shot_kind import Motion, classify_motion
from factorsfm.polish.camera_starts import converge, converge_cameras, core_tracks
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TRIANGULATION_VIEWS = 10
_WELL_HELD = 0.3  # of the largest number of tracks in a frame


@dataclass(frozen=True, slots=True)
class PolishStart:
    """Where the last adjustment starts.

    Attributes:
        state: of cameras and tracks; observations, tracks: that belong together, undistorted by the lens.
        sigma: of the tracks that hold the cameras, pixels; inflation: of its square, since errors repeat themselves.
        prior: with the weight it earns; lens, shutter: see `Polished`.
    """

    state: State
    observations: Observations
    tracks: Index
    sigma: float
    inflation: float
    motion: Motion
    prior: WeighedPrior | None
    lens: LensEstimate | None
    shutter: Shutter | None


def polish_start(
    images: list[MappedImage],
    observations: Observations,
    tracks: Index,
    map_points: tuple[Index, Array],
    guess: Lens,
    group: Index,
    frames: list[int],
    options: Options,
    first_focal: tuple[Array, float] | None,
    progress: Callable[[str], None],
) -> PolishStart:
    """The cameras on the longest tracks, what the shot says of lens, motion and prior, and all tracks that fit it.

    Args:
        images: registered, at the places `frames` of the shot; observations, tracks: theirs.
        map_points: track ids and positions of the incremental map.
        guess: of the lens; group: (k,) which of its focal lengths is that of each image.
        first_focal: see `polish`.
    """
    o = options.polish
    progress("polish: cameras")
    core = core_tracks(observations, len(images), everywhere=options.estimates_lens)
    few = observations.of(core)
    start = _first_guess(images, few, tracks[core], map_points, guess.focal, group, _world(observations))
    kept, adjustment = converge_cameras(start, few, options)
    core, few, lens, seen = core[kept], adjustment.observations, None, guess
    motion, shutter = None, None
    if few.sweep is not None:
        motion = classify_motion(adjustment, few, o)
        shutter = find_shutter(adjustment, motion, guess, options)
    if shutter is not None:
        seen = shutter.lens
        adjustment = converge(adjustment.state, shutter.renormalize(few, group), options)
    if options.estimates_lens:
        adjustment, lens = _estimate_lens(adjustment, seen, frames, options, first_focal)
        lens = replace(lens, guess=replace(lens.guess, shape=guess.shape))
        shutter = shutter and shutter.known_with(lens)
    if (change := lens or shutter) is not None:
        few, observations = adjustment.observations, change.renormalize(observations, adjustment.state.group)
    if motion is None or change is not None:
        motion = classify_motion(adjustment, few, o)
    inflation = block_inflation(adjustment.reprojection_vectors(), few)
    prior, part = None, motion.rotation_only
    if motion.kind is ShotKind.GENERAL:
        part = adjustment.state
        if o.depth:
            prior = weigh_prior(adjustment, few, tracks[core], [image.tracks for image in images], inflation)

    progress("polish: points")
    sigma = adjustment.sigma
    state = with_all_points(part, adjustment.state, observations, core)
    state = BundleAdjustment(
        state, observations, replace(o, iterations=4), ErrorModel(sigma), free=Free(cameras=False)
    ).solve()
    if o.observation_sigmas is None:
        observations, tracks, state = _without_outliers(state, observations, tracks, sigma, o)
    else:
        limit = o.observation_sigmas * sigma
        observations, tracks, state = _without_outlying_observations(state, observations, tracks, limit, o)
    return PolishStart(state, observations, tracks, sigma, inflation, motion, prior, lens, shutter)


def _first_guess(
    images: list[MappedImage],
    observations: Observations,
    tracks: Index,
    map_points: tuple[Index, Array],
    focal: Array,
    group: Index,
    world: int,
) -> State:
    """Poses in the frame of one of the cameras, points triangulated from a few views, median inverse distance 1."""
    rotation, origin = images[world].pose
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
    return State(turn, translation, bearing, inverse, np.log(focal), group=group, world=world)


def _triangulated(cameras: State, observations: Observations, points: Index, fallback: Array) -> Triangulation:
    """Some points from a few views each, spread over their tracks; `fallback` as in `triangulate`."""
    o = observations.of(points)
    start = o.first
    length = np.diff(np.append(start, len(o.point)))[o.point]
    place = np.arange(len(o.point)) - start[o.point]
    spaced = place * _TRIANGULATION_VIEWS // length > (place - 1) * _TRIANGULATION_VIEWS // length
    few = spaced | (place == length - 1)
    return triangulate(
        cameras.rotation,
        cameras.translation,
        o.at(few),
        focal=float(np.median(cameras.focal)),
        inlier_px=5.0,
        sigma=FIRST_SIGMA_PX,
        fallback=fallback,
    )


def _world(observations: Observations) -> int:
    """The first frame that the tracks hold well: from the others, the way to the solution is long."""
    count = np.bincount(observations.frame)
    return int(np.argmax(count >= _WELL_HELD * count.max()))


# --- stages -----------------------------------------------------------------------------------------------------------


def _estimate_lens(
    adjustment: BundleAdjustment,
    guess: Lens,
    frames: list[int],
    options: Options,
    first_focal: tuple[Array, float] | None,
) -> tuple[BundleAdjustment, LensEstimate]:
    """As `estimate_lens`, with a focal length for every frame where a zoom is asked for and found."""
    zoom = None
    if options.lens == "zoom" and len(guess.focal) == 1:
        zoom = find_zoom(adjustment, guess, np.array(frames, np.float64), options.polish)
    if zoom is None or not zoom.found:
        adjustment, lens = estimate_lens(adjustment, guess, options, first_focal=first_focal)
        return adjustment, replace(lens, zoom_std=zoom.std if zoom else None)
    zoomed = Lens(np.exp(zoom.adjustment.state.log_focal), guess.shape)
    prior = FocalPrior(np.zeros(len(frames)), zoom.information)
    adjustment, lens = estimate_lens(zoom.adjustment, zoomed, options, prior)
    seen = Lens(np.repeat(guess.focal, len(frames)), guess.shape)
    return adjustment, replace(lens, guess=seen, zoom_std=zoom.std)


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
    errors = BundleAdjustment(state, observations, options, ErrorModel(sigma)).reprojection_errors()
    typical = np.log(np.sqrt(observations.mean_by_point(errors**2)) + 1e-6)
    center = np.median(typical)
    spread = 1.4826 * np.median(np.abs(typical - center))
    keep = np.nonzero(typical < center + options.outlier_sigmas * max(spread, 0.1))[0]
    return observations.of(keep), tracks[keep], state.of(keep)


def _without_outlying_observations(
    state: State, observations: Observations, tracks: Index, limit_px: float, options: PolishOptions
) -> tuple[Observations, Index, State]:
    """Drop wrong matches one by one, and tracks of which less than two observations remain."""
    good = BundleAdjustment(state, observations, options, ErrorModel(1.0)).reprojection_errors() < limit_px
    good &= np.bincount(observations.point, good, len(tracks))[observations.point] >= 2
    keep = np.unique(observations.point[good])
    return observations.at(good).of(keep), tracks[keep], state.of(keep)
