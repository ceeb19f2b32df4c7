"""An unknown lens: a search over fields of view, then focal length, distortion and principal point in the polish."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.factors import distort
from factorsfm.noise import block_inflation, coordinate_sigma, image_cells
from factorsfm.observability import LEAST_GAIN, classify_motion, translation_gain
from factorsfm.options import FOCAL_STD, TOLD_FOCAL_STD, Options, PolishOptions
from factorsfm.problem import Observations, State
from factorsfm.reconstruction import ShotKind
from factorsfm.refinement import BundleAdjustment

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_FIELDS_OF_VIEW = np.radians(np.geomspace(20.0, 100.0, 8))  # across the longer side of what the tracks fill
_SEARCH_FRAMES, _SEARCH_ITERATIONS, _PARABOLAS = 24, 15, 3
_SHAPE_POWERS = np.array([2.0, 4.0, -1.0, -1.0])  # of the focal length in what displaces a pixel as far
_CLEARLY = 0.9  # of the cost without distortion, at which the shot asks for some
_TOLERANCE = 1e-5  # the focal length lies along a flat valley
_OPEN_FOCAL_STD = 0.02  # like `FOCAL_STD`, with what a distortion that is not believed leaves open
_DISTORTION_SIGMA = 0.1
_CENTER_SIGMA = 0.02  # of the width
_HELD_STD = 1e-6  # relative, of a focal length that is known
_LARGEST_RATIO = 4.0  # of the focal length to its guess
_MISFIT = 1.5  # of the standard deviation above which a solution is doubted
_CELLS = (6, 4)  # across and down, in which the errors of tracks may be alike
_LEFT_OUT = (3, 2, 3)  # parts across, down and in time, of which one at a time is left out
# Distortion is believed where errors hardly explain it: random ones, and those of tracks that err together, of an actor
# without a mask above all, which look like a displacement of 1 to 4 thousandths of the width at the outermost tracks.
_LEAST_EVIDENCE = 9.0  # squared standard deviations
_JOINT_DISPLACEMENT = 0.00125  # of the width: standard deviation


@dataclass(frozen=True, slots=True)
class Lens:
    """(g,) focal lengths (pixels), and (4,) distortion and principal point as in `factors.distort`."""

    focal: Array
    shape: Array


class _NotInvertible(Exception):
    """Some pixels are seen by no ray of this lens."""


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """What became of an unknown lens.

    Attributes:
        guess: with which the tracks were undistorted; lens: what the shot says, or the guess.
        focal_std: (g,) relative standard deviations of the estimated focal lengths, believed or not; 0 of known ones.
        shape_std: (4,) standard deviations of the shape, NaN where it stays as guessed.
        misfit_px: standard deviation of the tracks where they fit no lens: what an estimate says is chance then;
            0 where they do.
        determined: whether the focal lengths are estimates, not the guess.
        rough: whether they are not, but the shot knows more than the guess: means of both, each as it is known.
        zoom_std: relative standard deviation of the ratio of the longest to the shortest focal length where a zoom was
            looked for, whether one was found or not; None: none was. The course of a zoom is an estimate in any case.
    """

    guess: Lens
    lens: Lens
    focal_std: Array
    shape_std: Array
    misfit_px: float
    determined: bool
    rough: bool = False
    zoom_std: float | None = None

    def renormalize(self, observations: Observations, group: Index) -> Observations:
        """What was undistorted by the guess, undistorted by the lens; `group` as in `State`."""
        return renormalized(observations, self.guess, self.lens, group)


def undistort(xy: Array, shape: Array) -> Array:
    """Inverse of `factors.distort`: (n, 2) undistorted coordinates, NaN where there are none."""
    if not shape.any():
        return xy
    k1, k2, x, y = shape
    camera = pycolmap.Camera(model="RADIAL", width=1, height=1, params=[1.0, x, y, k1, k2])
    return np.asarray(camera.cam_from_img(xy), np.float64)


def renormalized(observations: Observations, before: Lens, after: Lens, group: Index) -> Observations:
    """The same pixels, undistorted by another lens; `group` as in `State`."""
    seen = distort(observations.xy, before.shape)[0] if before.shape.any() else observations.xy
    ratio = (before.focal / after.focal)[group[observations.frame], None]
    return replace(observations, xy=undistort(seen * ratio, after.shape))


def through(state: State, focal: Array) -> State:
    """The state with other focal lengths (g,): points where the world's camera sees them, and as deep as they are."""
    own = state.group[state.world]
    stretch = np.exp(state.log_focal[own]) / focal[own]
    bearing = state.bearing * [stretch, stretch, 1.0]
    length = np.linalg.norm(bearing, axis=1)
    return replace(
        state,
        bearing=bearing / length[:, None],
        inverse_distance=state.inverse_distance / length,
        log_focal=np.log(focal),
    )


def estimate_lens(
    adjustment: BundleAdjustment,
    guess: Lens,
    options: Options,
    focal_prior: tuple[Array, Array] | None = None,
    first_focal: tuple[Array, float] | None = None,
) -> tuple[BundleAdjustment, LensEstimate]:
    """The lens where the shot determines it, else what was thought first; and the cameras with it.

    Args:
        adjustment: converged with the guess; focal_prior: as in `BundleAdjustment`.
        first_focal: (g,) what was thought of the focal lengths first, pixels, and the relative standard deviation of
            that; None: those of the guess, which are kept where the shot determines none.

    Returns:
        The adjustment with undistorted observations, whose `observations` are those of the lens.
    """
    o = replace(options.polish, tolerance=_TOLERANCE)
    groups, width = len(guess.focal), float(np.ptp(adjustment.observations.xy, axis=0).max())
    held = not options.refine_focal_length
    sigmas = {
        "focal": np.zeros(4),
        "distortion": np.array([_DISTORTION_SIGMA, _DISTORTION_SIGMA, 0.0, 0.0]),
        "all": np.array([_DISTORTION_SIGMA, _DISTORTION_SIGMA, _CENTER_SIGMA * width, _CENTER_SIGMA * width]),
    }["distortion" if held or options.lens == "zoom" else options.lens]
    group = adjustment.state.group

    def seen_through(lens: Lens) -> tuple[State, Observations]:
        state = replace(through(adjustment.state, lens.focal), lens=lens.shape)
        return state, renormalized(adjustment.observations, guess, lens, group)

    first, bent = guess, None
    if held:
        focal_prior = np.log(guess.focal), np.eye(groups) / _HELD_STD**2
    else:
        first, cost = search_lens(adjustment, guess, o)
        if sigmas.any():
            bent, bent_cost = search_lens(adjustment, guess, o, sigmas)
            if not bent_cost < _CLEARLY * cost:
                bent = None
    start, observations = seen_through(first)
    best, moves = _solved_as_it_moves(start, observations, o, adjustment.sigma, np.zeros(4), focal_prior)
    std, left_out, _ = _standard_deviations(best)
    known = float(np.fmax(std, left_out)[:groups].max()) < FOCAL_STD
    # Strong distortion moves the valley of the focal length: a start without any does not lead there.
    starts = [(*seen_through(bent), adjustment.sigma, True)] if bent is not None else []
    starts += [(best.state, best.observations, best.sigma, moves)] if sigmas.any() else []
    found = _with_free_shape(starts, o, sigmas, focal_prior)
    if found is not None:
        full, full_moves = found
        full_std, full_left_out, evidence = _standard_deviations(full, guess.shape)
        displacement = _displacement(full, guess.shape)
        logger.info(
            "distortion %s, %.0f squared deviations, displaces by %.1f pixels; focal length within %.2f %%",
            np.round(full.state.lens, 4), evidence, displacement, 100 * max(full_std[0], full_left_out[0]),
        )  # fmt: skip
        joint = _JOINT_DISPLACEMENT * width * float(np.median(guess.focal)) / max(displacement, 1e-9)
        believed = evidence > _LEAST_EVIDENCE * (1.0 + evidence * joint**2)  # both variances add up
        if believed and full_std[:groups].max() < FOCAL_STD:
            best, moves, std, left_out = full, full_moves, full_std, full_left_out
            known = float(np.fmax(std, left_out)[:groups].max()) < FOCAL_STD
        else:  # a distortion that is not believed may be there all the same: second moment around what is kept
            moved = np.append(full.state.log_focal - best.state.log_focal, np.full(4, np.nan))
            std, left_out = (
                np.fmax(kept, np.hypot(opened, moved)) for kept, opened in ((std, full_std), (left_out, full_left_out))
            )
            known &= float(np.fmax(std, left_out)[:groups].max()) < _OPEN_FOCAL_STD
    lens = Lens(np.exp(best.state.log_focal), best.state.lens)
    focal_std, shape_std = np.split(np.fmax(std, left_out), [groups])
    focal_std = np.zeros(groups) if held else focal_std
    logger.info("focal length %s pixels within %s %%, guess %s", lens.focal, 100 * focal_std, guess.focal)
    misfit = best.sigma if best.sigma > _MISFIT * o.doubtful_px else 0.0
    far = np.abs(np.log(lens.focal / guess.focal)).max() > np.log(_LARGEST_RATIO)
    known &= not (misfit or far)
    if known:
        final, rough = lens, False
    else:
        # In a long valley a standard deviation says little.
        counts = not (misfit or far) and float(std[:groups].max()) < TOLD_FOCAL_STD
        focal, rough = _kept_focal(lens.focal, focal_std, first_focal or (guess.focal, 0.0), counts=counts)
        final = Lens(focal, lens.shape if rough else guess.shape)
    if known or rough:
        state, observations, before = best.state if moves else through(start, lens.focal), best.observations, lens
    else:
        state, observations, before = adjustment.state, adjustment.observations, guess
    if final is not before:
        state, observations = through(state, final.focal), renormalized(observations, before, final, group)
    settled = BundleAdjustment(
        replace(state, lens=np.zeros(4)), observations, options.polish,
        sigma=best.sigma if known or rough else adjustment.sigma,
    )  # fmt: skip
    settled.solve()
    return settled, LensEstimate(
        guess, final, focal_std, shape_std if known or rough else np.full(4, np.nan), misfit, known, rough
    )  # fmt: skip


def _kept_focal(found: Array, std: Array, first: tuple[Array, float], *, counts: bool) -> tuple[Array, bool]:
    """Focal lengths that the shot does not determine, (g,), and whether it has a say in them.

    Where it counts, and knows them better than they were known at first, they are the means of the logarithms of both,
    each weighed by its variance; else those of before.
    """
    focal, first_std = first
    if not counts or float(std.max()) >= first_std:
        return focal, False
    share = first_std**2 / (first_std**2 + std**2)
    return np.asarray(found**share * focal ** (1.0 - share)), True


def search_lens(
    adjustment: BundleAdjustment, guess: Lens, options: PolishOptions, sigmas: Array | None = None
) -> tuple[Lens, float]:
    """The guess, its focal lengths times the factor with which a few frames fit best, and the cost of these.

    Candidates, then parabolas around the best.

    Args:
        sigmas: (4,) with which the shape is free around the guess; None: it is that of the guess.
    """
    state, few = _some_frames(adjustment.state, adjustment.observations)
    options = replace(options, iterations=_SEARCH_ITERATIONS, tolerance=1e-3)
    known = np.zeros(4) if sigmas is None and guess.shape.any() else sigmas

    def fit(near: State, factor: float) -> tuple[float, State]:
        focal = factor * guess.focal
        ratio = float(focal[0] / np.exp(near.log_focal[0])) if sigmas is not None else 1.0
        lens = Lens(focal, near.lens * ratio**_SHAPE_POWERS)  # the same pixels are moved as far
        seen = renormalized(few, guess, lens, state.group)
        if not np.isfinite(seen.xy).all():  # some pixels are seen by no ray of this lens
            return np.inf, near
        problem = BundleAdjustment(
            replace(through(near, focal), lens=lens.shape), seen, options,
            sigma=adjustment.sigma, lens_sigmas=known, lens_mean=guess.shape,
        )  # fmt: skip
        problem.solve()
        return problem.cost(), problem.state

    candidates = np.sort(0.5 * float(np.ptp(few.xy, axis=0).max()) / np.tan(_FIELDS_OF_VIEW / 2))
    fits = {1.0: fit(replace(state, lens=guess.shape), 1.0)}
    for side in (candidates[candidates > 1.0], candidates[candidates < 1.0][::-1]):
        near = fits[1.0][1]
        for factor in side.tolist():
            fits[factor] = fit(near, factor)
            near = fits[factor][1]
    for _ in range(_PARABOLAS):
        factors = sorted(fits)
        best = min(range(len(factors)), key=lambda i: fits[factors[i]][0])
        around = factors[max(best - 1, 0) : best + 2]
        costs = [fits[f][0] for f in around]
        if len(around) < 3 or not np.isfinite(costs).all():
            break
        x = np.log(np.array(around) / around[1])
        curvature, slope, _ = np.polyfit(x, costs, 2)
        factor = around[1] * float(np.exp(np.clip(-0.5 * slope / curvature, 0.5 * x[0], 0.5 * x[2])))
        fits[factor] = fit(fits[around[1]][1], factor)
    factor = min(fits, key=lambda f: fits[f][0])
    cost, found = fits[factor]
    return Lens(factor * guess.focal, found.lens), cost


def _some_frames(state: State, observations: Observations) -> tuple[State, Observations]:
    """Few frames, evenly spread, that of the world among them, and the points that two of them see."""
    count = len(state.rotation)
    frames = np.unique([*np.linspace(0, count - 1, min(count, _SEARCH_FRAMES)).astype(int), state.world])
    keep = np.isin(observations.frame, frames)
    seen = np.bincount(observations.point[keep], minlength=len(state.bearing)) >= 2
    keep &= seen[observations.point]
    points = np.flatnonzero(seen)
    part = replace(
        state.of(points),
        rotation=state.rotation[frames],
        translation=state.translation[frames],
        group=state.group[frames],
        world=int(np.searchsorted(frames, state.world)),
    )
    frame, point = observations.frame[keep], observations.point[keep]
    return part, Observations(
        np.searchsorted(frames, frame), np.searchsorted(points, point), observations.xy[keep]
    )  # fmt: skip


def _with_free_shape(
    starts: list[tuple[State, Observations, float, bool]],
    options: PolishOptions,
    sigmas: Array,
    focal_prior: tuple[Array, Array] | None,
) -> tuple[BundleAdjustment, bool] | None:
    """As `_solved_as_it_moves`, from the first start (with its noise, and whether it moves) that leads to a lens."""
    for state, observations, sigma, moves in starts:
        try:
            return _solved_as_it_moves(state, observations, options, sigma, sigmas, focal_prior, moves=moves)
        except _NotInvertible:
            continue
    return None


def _solved_as_it_moves(
    state: State,
    observations: Observations,
    options: PolishOptions,
    sigma: float,
    sigmas: Array,
    focal_prior: tuple[Array, Array] | None,
    *,
    moves: bool = True,
) -> tuple[BundleAdjustment, bool]:
    """As `solved_with_lens`, and whether the camera moves: a translation that is none would bend with the lens."""
    best = solved_with_lens(state, observations, options, sigma, sigmas, moves=moves, focal_prior=focal_prior)
    if not moves:
        return best, False
    undistorted = BundleAdjustment(best.state, best.observations, options, sigma=best.sigma)
    motion = classify_motion(undistorted, best.observations, options)
    general = motion.kind is ShotKind.GENERAL
    if general and sigmas.any():  # the lens may have bent with a translation that is none: let it do without
        rotating = BundleAdjustment(
            motion.rotation_only, best.observations, options, sigma=best.sigma, free_translation=False, free_focal=True,
            focal_prior=focal_prior, lens_sigmas=sigmas,
        )  # fmt: skip
        rotating.solve()
        general = translation_gain(rotating, undistorted) > LEAST_GAIN
    if general:
        return best, True
    still = solved_with_lens(
        motion.rotation_only, best.observations, options, best.sigma, sigmas, moves=False, focal_prior=focal_prior
    )
    return still, False


def solved_with_lens(
    state: State,
    observations: Observations,
    options: PolishOptions,
    sigma: float,
    sigmas: Array,
    *,
    moves: bool = True,
    focal_prior: tuple[Array, Array] | None = None,
) -> BundleAdjustment:
    """Converged over the lens too, first at the noise that is thought, then at that of the residuals.

    Its observations are undistorted by the lens of its state.

    Raises:
        _NotInvertible: on the way there is a lens that does not see some of the pixels.
    """
    known = None if not state.lens.any() and not sigmas.any() else sigmas
    for _ in range(2):
        _check_invertible(observations)
        problem = BundleAdjustment(
            state, observations, options, sigma=sigma, free_translation=moves, free_focal=True,
            focal_prior=focal_prior, lens_sigmas=known,
        )  # fmt: skip
        problem.solve()
        before, after = (Lens(np.exp(s.log_focal), s.lens) for s in (state, problem.state))
        state, observations = problem.state, renormalized(observations, before, after, state.group)
        sigma = coordinate_sigma(problem.reprojection_errors())
    _check_invertible(observations)
    return BundleAdjustment(
        state, observations, options, sigma=sigma, free_translation=moves, free_focal=True,
        focal_prior=focal_prior, lens_sigmas=known,
    )  # fmt: skip


def _check_invertible(observations: Observations) -> None:
    if not np.isfinite(observations.xy).all():
        raise _NotInvertible


def _standard_deviations(adjustment: BundleAdjustment, guess: Array | None = None) -> tuple[Array, Array, float]:
    """(g + 4,) of log focal lengths and shape, NaN where held; and the evidence that the shape is not the guess.

    First from the residuals, of whose covariances the most doubtful one counts, then from what parts of the shot say.
    """
    groups = len(adjustment.state.log_focal)
    covariances = [*lens_covariances(adjustment), _left_out_covariance(adjustment)]
    std = np.full((len(covariances), groups + 4), np.nan)
    std[:, adjustment.free_lens] = np.sqrt([c.diagonal() for c in covariances])
    evidence = 0.0
    if guess is not None:
        away = (adjustment.state.lens - guess)[adjustment.free_lens[groups:] - groups]
        evidence = min(float(away @ np.linalg.solve(c[groups:, groups:], away)) for c in covariances)
    return std[:-1].max(0), std[-1], evidence


def lens_covariances(adjustment: BundleAdjustment) -> list[Array]:
    """Covariance of the free ones of log focal lengths and shape, seen in several ways.

    Errors that are alike for a while, or in a part of the image, or as long as a track lives, count as one. How many
    there are is seen in blocks of residuals, and in how differently the parts of the image, and the tracks, pull.
    """
    columns = 6 * len(adjustment.state.rotation) + adjustment.free_lens
    whole, _ = adjustment.covariance(np.zeros(0, np.int64))
    inflation = block_inflation(adjustment.reprojection_vectors(), adjustment.observations)
    o, influence = adjustment.observations, adjustment.influences(columns)
    xy = np.stack([np.bincount(o.point, o.xy[:, i]) for i in range(2)], -1) / np.bincount(o.point)[:, None]
    parts = image_cells(xy, *_CELLS), np.arange(len(xy))
    return [whole[np.ix_(columns, columns)] * inflation, *(_pulled_covariance(influence, part) for part in parts)]


def _pulled_covariance(influence: Array, part: Index) -> Array:
    """Covariance from how differently groups of points pull; `part`: (n,) group of each point."""
    used, key = np.unique(part, return_inverse=True)
    pull = np.stack([np.bincount(key, column) for column in influence.T], -1)
    return np.asarray(pull.T @ pull * (len(used) / max(len(used) - 1, 1)))


def _left_out_covariance(adjustment: BundleAdjustment) -> Array:
    """Covariance as in `lens_covariances`, from where the solution goes without each part of the shot: a jackknife.

    A part that says much of the cameras draws them to itself, and its residuals hide how wrong it is; left out, it
    cannot.
    """
    o = adjustment.observations
    across, down, stretches = _LEFT_OUT
    time = o.frame * stretches // (int(o.frame.max()) + 1)
    part = time * across * down + image_cells(o.xy, across, down)
    steps = np.array([adjustment.of(part != left_out).lens_step() for left_out in np.unique(part)])
    steps -= steps.mean(0)
    return np.asarray(steps.T @ steps * ((len(steps) - 1) / len(steps)))


def _displacement(adjustment: BundleAdjustment, guess: Array) -> float:
    """By how much the shape moves the outermost observations against the guess (pixels)."""
    o, state = adjustment.observations, adjustment.state
    moved = state.focal[o.frame, None] * (distort(o.xy, state.lens)[0] - distort(o.xy, guess)[0])
    return float(np.percentile(np.linalg.norm(moved, axis=1), 99))
