"""An unknown lens: focal length, distortion and principal point solved with the cameras, and what of it counts."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import DISTORTION, READOUT, Observations
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free, Known, LensPrior
from factorsfm.adjustment.residuals import distort
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.lens.certainty import lens_deviations
from factorsfm.lens.lens import READOUT_SIGMA, Lens, LensEstimate, renormalized, shape_sigmas, through
from factorsfm.lens.search import search_lens
from factorsfm.motion.shot_kind import LEAST_GAIN, classify_motion, translation_gain
from factorsfm.support.options import DETERMINED_FOCAL_STD, GIVEN_FOCAL_STD, Options, PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_CLEARLY = 0.9  # of the cost without distortion, at which the shot asks for some
_TOLERANCE = 1e-5  # the focal length lies along a flat valley
_OPEN_FOCAL_STD = 0.02  # like `DETERMINED_FOCAL_STD`, with what a distortion that is not believed leaves open
_HELD_STD = 1e-6  # relative, of a focal length that is known
_LARGEST_RATIO = 4.0  # of the focal length to its guess
_MISFIT = 1.5  # of the standard deviation above which a solution is doubted
# Distortion is believed where errors hardly explain it: random ones, and those of tracks that err together, of an actor
# without a mask above all, which look like a displacement of 1 to 4 thousandths of the width at the outermost tracks.
_LEAST_EVIDENCE = 9.0  # squared standard deviations
_JOINT_DISPLACEMENT = 0.00125  # of the width: standard deviation


class _NotInvertible(Exception):
    """Some pixels are seen by no ray of this lens."""


@dataclass(frozen=True, slots=True)
class _Solution:
    """A lens solved with the cameras.

    Attributes:
        moves: whether the camera does.
        std, left_out: (g + 6,) of log focal lengths and shape, as in `lens_deviations`.
        known: whether the focal lengths count as determined.
    """

    adjustment: BundleAdjustment
    moves: bool
    std: Array
    left_out: Array
    known: bool

    @property
    def lens(self) -> Lens:
        state = self.adjustment.state
        return Lens(np.exp(state.log_focal), state.lens)


def estimate_lens(
    adjustment: BundleAdjustment,
    guess: Lens,
    options: Options,
    focal_prior: FocalPrior | None = None,
    first_focal: tuple[Array, float] | None = None,
) -> tuple[BundleAdjustment, LensEstimate]:
    """The lens where the shot determines it, else what was thought first; and the cameras with it.

    Args:
        adjustment: converged with the guess; focal_prior: what is known of the focal lengths.
        first_focal: (g,) what was thought of the focal lengths first, pixels, and the relative standard deviation of
            that; None: those of the guess, which are kept where the shot determines none.

    Returns:
        The adjustment with undistorted observations, whose `observations` are those of the lens.
    """
    o = replace(options.polish, tolerance=_TOLERANCE)
    groups, width = len(guess.focal), float(np.ptp(adjustment.observations.xy, axis=0).max())
    held = not options.refine_focal_length
    shutter = np.where(guess.shape[READOUT] != 0.0, READOUT_SIGMA, 0.0)
    straight_sigmas = np.r_[np.zeros(4), shutter]
    sigmas = np.r_[shape_sigmas(options.lens, width), shutter]
    bends = bool(sigmas[DISTORTION].any())
    group = adjustment.state.group

    def seen_through(lens: Lens) -> tuple[State, Observations]:
        state = replace(through(adjustment.state, lens.focal), lens=lens.shape)
        return state, renormalized(adjustment.observations, guess, lens, group)

    first, bent = guess, None
    if held:
        focal_prior = FocalPrior(np.log(guess.focal), np.eye(groups) / _HELD_STD**2)
    else:
        first, cost = search_lens(adjustment, guess, o)
        if bends:
            bent, bent_cost = search_lens(adjustment, guess, o, sigmas)
            if not bent_cost < _CLEARLY * cost:
                bent = None
    start, observations = seen_through(first)
    straight, moves = _solved_as_it_moves(start, observations, o, adjustment.sigma, straight_sigmas, focal_prior)
    std, left_out, _ = lens_deviations(straight)
    best = _Solution(straight, moves, std, left_out, _largest(std, left_out, groups) < DETERMINED_FOCAL_STD)
    # Strong distortion moves the valley of the focal length: a start without any does not lead there.
    starts = [(*seen_through(bent), adjustment.sigma, True)] if bent is not None else []
    starts += [(straight.state, straight.observations, straight.sigma, moves)] if bends else []
    free = _with_free_shape(starts, o, sigmas, focal_prior)
    if free is not None:
        best = _judged_shape(best, free, guess, width)

    lens = best.lens
    focal_std, shape_std = np.split(np.fmax(best.std, best.left_out), [groups])
    focal_std = np.zeros(groups) if held else focal_std
    logger.info("focal length %s pixels within %s %%, guess %s", lens.focal, 100 * focal_std, guess.focal)
    misfit = best.adjustment.sigma if best.adjustment.sigma > _MISFIT * o.doubtful_px else 0.0
    sound = not misfit and np.abs(np.log(lens.focal / guess.focal)).max() <= np.log(_LARGEST_RATIO)
    known, rough, final = best.known and bool(sound), False, lens
    if not known:
        # In a long valley a standard deviation says little.
        counts = sound and float(best.std[:groups].max()) < GIVEN_FOCAL_STD
        focal, rough = _kept_focal(lens.focal, focal_std, first_focal or (guess.focal, 0.0), counts=counts)
        final = Lens(focal, lens.shape if rough else guess.shape)
    state, observations, before = adjustment.state, adjustment.observations, guess
    if known or rough:
        state = best.adjustment.state if best.moves else through(start, lens.focal)
        observations, before = best.adjustment.observations, lens
    if final is not before:
        state, observations = through(state, final.focal), renormalized(observations, before, final, group)
    settled = BundleAdjustment(
        replace(state, lens=np.zeros(LENS_SIZE)),
        observations,
        options.polish,
        ErrorModel(best.adjustment.sigma if known or rough else adjustment.sigma),
    )
    settled.solve()
    return settled, LensEstimate(
        guess, final, focal_std, shape_std if known or rough else np.full(LENS_SIZE, np.nan), misfit, known, rough
    )  # fmt: skip


def _judged_shape(straight: _Solution, free: tuple[BundleAdjustment, bool], guess: Lens, width: float) -> _Solution:
    """The solution with a free shape where it is believed, else the one without, as uncertain as the other makes it.

    Args:
        free: with a free shape, and whether its camera moves; width: of what the tracks fill, normalised.
    """
    groups = len(guess.focal)
    full, moves = free
    std, left_out, evidence = lens_deviations(full, guess.shape)
    displacement = _displacement(full, guess.shape)
    logger.info(
        "distortion %s, %.0f squared deviations, displaces by %.1f pixels; focal length within %.2f %%",
        np.round(full.state.lens, 4), evidence, displacement, 100 * _largest(std, left_out, groups),
    )  # fmt: skip
    joint = _JOINT_DISPLACEMENT * width * float(np.median(guess.focal)) / max(displacement, 1e-9)
    believed = evidence > _LEAST_EVIDENCE * (1.0 + evidence * joint**2)  # both variances add up
    if believed and std[:groups].max() < DETERMINED_FOCAL_STD:
        return _Solution(full, moves, std, left_out, _largest(std, left_out, groups) < DETERMINED_FOCAL_STD)
    # A distortion that is not believed may be there all the same: second moment around what is kept.
    moved = np.append(full.state.log_focal - straight.adjustment.state.log_focal, np.full(LENS_SIZE, np.nan))
    std, left_out = (
        np.fmax(kept, np.hypot(opened, moved)) for kept, opened in ((straight.std, std), (straight.left_out, left_out))
    )
    known = straight.known and _largest(std, left_out, groups) < _OPEN_FOCAL_STD
    return replace(straight, std=std, left_out=left_out, known=known)


def _largest(std: Array, left_out: Array, groups: int) -> float:
    """Standard deviation of the focal length that is known worst."""
    return float(np.fmax(std, left_out)[:groups].max())


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


def _with_free_shape(
    starts: list[tuple[State, Observations, float, bool]],
    options: PolishOptions,
    sigmas: Array,
    focal_prior: FocalPrior | None,
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
    focal_prior: FocalPrior | None,
    *,
    moves: bool = True,
) -> tuple[BundleAdjustment, bool]:
    """As `solved_with_lens`, and whether the camera moves: a translation that is none would bend with the lens."""
    best = solved_with_lens(state, observations, options, sigma, sigmas, moves=moves, focal_prior=focal_prior)
    if not moves:
        return best, False
    undistorted = BundleAdjustment(best.state, best.observations, options, ErrorModel(best.sigma))
    motion = classify_motion(undistorted, best.observations, options)
    general = motion.kind is ShotKind.GENERAL
    if general and sigmas.any():  # the lens may have bent with a translation that is none: let it do without
        rotating = BundleAdjustment(
            motion.rotation_only, best.observations, options, ErrorModel(best.sigma),
            free=Free(translation=False, focal=True),
            known=Known(focal_prior, LensPrior(motion.rotation_only.lens, sigmas)),
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
    focal_prior: FocalPrior | None = None,
) -> BundleAdjustment:
    """Converged over the lens too, first at the noise that is thought, then at that of the residuals.

    Its observations are undistorted by the lens of its state.

    Raises:
        _NotInvertible: on the way there is a lens that does not see some of the pixels.
    """
    bends = bool(state.lens.any() or sigmas.any())

    def problem(state: State, observations: Observations, sigma: float) -> BundleAdjustment:
        _check_invertible(observations)
        known = Known(focal_prior, LensPrior(state.lens, sigmas) if bends else None)
        free = Free(translation=moves, focal=True)
        return BundleAdjustment(state, observations, options, ErrorModel(sigma), free=free, known=known)

    for _ in range(2):
        solved = problem(state, observations, sigma)
        solved.solve()
        before, after = (Lens(np.exp(s.log_focal), s.lens) for s in (state, solved.state))
        state, observations = solved.state, renormalized(observations, before, after, state.group)
        sigma = coordinate_sigma(solved.reprojection_errors())
    return problem(state, observations, sigma)


def _check_invertible(observations: Observations) -> None:
    if not np.isfinite(observations.xy).all():
        raise _NotInvertible


def _displacement(adjustment: BundleAdjustment, guess: Array) -> float:
    """By how much the shape moves the outermost observations against the guess (pixels)."""
    o, state = adjustment.observations, adjustment.state
    moved = state.focal[o.frame, None] * (distort(o.xy, state.lens)[0] - distort(o.xy, guess)[0])
    return float(np.percentile(np.linalg.norm(moved, axis=1), 99))
