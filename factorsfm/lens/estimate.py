"""An unknown lens: focal length, distortion, principal point, and whether to believe what is found of them."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import DISTORTION, READOUT
from factorsfm.adjustment.problem import ErrorModel, FocalPrior
from factorsfm.adjustment.residuals import distort
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.lens.certainty import lens_deviations
from factorsfm.lens.lens import READOUT_SIGMA, Lens, LensEstimate, observed_width, shape_sigmas, through
from factorsfm.lens.search import FoundLens, found_lens
from factorsfm.lens.solver import LensSolver, NotInvertibleError
from factorsfm.motion.shot_kind import classify_motion
from factorsfm.support.options import DETERMINED_FOCAL_STD, GIVEN_FOCAL_STD, LensFreedom, Options

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_TOLERANCE = 1e-5  # the focal length lies along a flat valley
_OPEN_FOCAL_STD = 0.02  # like `DETERMINED_FOCAL_STD`, where a distortion that is not believed is part of it
_HELD_STD = 1e-6  # relative, of a focal length that is known
_LARGEST_RATIO = 4.0  # of the focal length to the guess
# Of log focal length: up to this a camera that turns keeps what it has found, since through the guess it would seem to
# move; beyond, it turns by so little that the guess explains the images as well.
_TURNING_STD = 1.0
_CONTRADICTION = 3.0  # standard deviations between what the shot and what EXIF data say
_MISFIT = 1.5  # of the standard deviation above which a solution is doubted
# Distortion is believed where neither random errors explain it nor those of tracks that move together: an actor without
# a mask looks like a displacement of 1 to 4 thousandths of the width at the outermost tracks, and what compression does
# to whole blocks like one of several times the noise of a track.
_LEAST_EVIDENCE = 9.0  # squared standard deviations
_JOINT_DISPLACEMENT, _JOINT_NOISE = 0.00125, 3.0  # standard deviations: of the width, and times the noise


@dataclass(frozen=True, slots=True)
class _Solution:
    """A lens solved with the cameras.

    Attributes:
        moves: whether the camera does.
        std, left_out: (g + 6,) of log focal lengths and shape, as in `lens_deviations`.
        known: whether the focal lengths count as determined.
        believed: whether its distortion is.
    """

    adjustment: BundleAdjustment
    moves: bool
    std: Array
    left_out: Array
    known: bool
    believed: bool

    @property
    def lens(self) -> Lens:
        return Lens.of(self.adjustment.state)

    @property
    def groups(self) -> int:
        """Number of focal lengths."""
        return len(self.adjustment.state.log_focal)

    @property
    def deviations(self) -> tuple[Array, Array]:
        """(g,) and (6,) standard deviations of log focal lengths and shape: the larger ones of both."""
        focal, shape = np.split(np.fmax(self.std, self.left_out), [self.groups])
        return focal, shape


def estimate_lens(
    adjustment: BundleAdjustment,
    options: Options,
    focal_prior: FocalPrior | None = None,
    first_focal: tuple[Array, float] | None = None,
    *,
    search: FoundLens | None = None,
    moves: bool = True,
) -> tuple[BundleAdjustment, LensEstimate]:
    """The lens where the shot determines it, else the first guess; and the cameras solved with it.

    Args:
        adjustment: converged with the guess, or with what the search found; focal_prior: of the focal lengths, None
            for none.
        first_focal: (g,) focal lengths as they were known first, pixels, and their relative standard deviation; None:
            those of the guess, which are kept where the shot determines none.
        search: where to start, None to search where it is needed.
        moves: whether the camera may; one that only turns has found its focal length already (`turning_camera`), and
            a translation would only bend it.
    """
    guess, width = Lens.of(adjustment.state), observed_width(adjustment.state, adjustment.observations)
    if search is not None:
        guess = Lens(search.guess.focal, np.r_[search.guess.shape[DISTORTION], guess.shape[READOUT]])
    straight_sigmas, sigmas = _prior_sigmas(guess, options.lens, width)
    held = not options.refine_focal_length
    if held:
        focal_prior = FocalPrior(np.log(guess.focal), np.eye(len(guess.focal)) / _HELD_STD**2)
    o = replace(options.polish, tolerance=_TOLERANCE)
    start, bent = adjustment.state, None
    if moves and not held:
        search = search or found_lens(adjustment, o, sigmas)
        start, bent = _seen_through(start, Lens(search.straight.focal, guess.shape)), search.bent
    solver = LensSolver(adjustment.observations, o, focal_prior)
    free: _Solution | None = None
    if bent is not None and sigmas[DISTORTION].any():
        # Strong distortion moves the valley of the focal length: a start without any does not lead there.
        bent = Lens(bent.focal, np.r_[bent.shape[DISTORTION], guess.shape[READOUT]])
        free = _free_solution(
            solver, _seen_through(adjustment.state, bent), adjustment.sigma, sigmas, guess, moves=moves
        )
    if free is not None and free.believed:
        best = free
    else:
        by_itself = start if moves else classify_motion(adjustment, options.polish).rotation_only
        straight = _straight_solution(solver, by_itself, adjustment.sigma, straight_sigmas, moves=moves)
        if free is None and sigmas[DISTORTION].any():
            solved = straight.adjustment
            free = _free_solution(solver, solved.state, solved.sigma, sigmas, guess, moves=straight.moves)
        best = straight if free is None else free if free.believed else _with_doubt_of(straight, free)
    estimate = _concluded(best, guess, first_focal or (guess.focal, 0.0), options, held=held)
    return _settled(adjustment, best, estimate, start, options), estimate


# --- stages -----------------------------------------------------------------------------------------------------


def _prior_sigmas(guess: Lens, freedom: LensFreedom, width: float) -> tuple[Array, Array]:
    """(6,) prior standard deviations of the shape: without distortion, and with what the options leave free."""
    readout = np.where(guess.shape[READOUT] != 0.0, READOUT_SIGMA, 0.0)
    return np.r_[np.zeros(4), readout], np.r_[shape_sigmas(freedom, width), readout]


def _seen_through(state: State, lens: Lens) -> State:
    """The state with another lens."""
    return replace(through(state, lens.focal), lens=lens.shape)


def _straight_solution(solver: LensSolver, start: State, sigma: float, sigmas: Array, *, moves: bool) -> _Solution:
    """The solution without free distortion."""
    adjustment, moves = solver.solved_as_it_moves(start, sigma, sigmas, moves=moves)
    std, left_out, _ = lens_deviations(adjustment)
    known = _largest(std, left_out, len(start.log_focal)) < DETERMINED_FOCAL_STD
    return _Solution(adjustment, moves, std, left_out, known, believed=False)


def _free_solution(
    solver: LensSolver, start: State, sigma: float, sigmas: Array, guess: Lens, *, moves: bool
) -> _Solution | None:
    """The solution with free distortion, None where no invertible lens is found."""
    try:
        full, moves = solver.solved_as_it_moves(start, sigma, sigmas, moves=moves)
    except NotInvertibleError:
        return None
    groups = len(full.state.log_focal)
    std, left_out, evidence = lens_deviations(full, guess.shape)
    displacement = _displacement(full, guess.shape)
    largest = _largest(std, left_out, groups)
    logger.info(
        "distortion %s, %.0f squared deviations, displaces by %.1f pixels, noise %.2f; focal length within %.2f %%",
        np.round(full.state.lens, 4), evidence, displacement, full.sigma, 100 * largest,
    )  # fmt: skip
    width = observed_width(full.state, full.observations) * float(np.median(full.state.focal))
    joint = np.hypot(_JOINT_DISPLACEMENT * width, _JOINT_NOISE * full.sigma)
    joint /= max(displacement, 1e-9)
    believed = evidence > _LEAST_EVIDENCE * (1.0 + evidence * joint**2)  # both variances add up
    believed &= std[:groups].max() < DETERMINED_FOCAL_STD
    return _Solution(full, moves, std, left_out, largest < DETERMINED_FOCAL_STD, bool(believed))


def _with_doubt_of(straight: _Solution, free: _Solution) -> _Solution:
    """The solution without free distortion, as uncertain as one makes it that is not believed, but may be there all the
    same: second moments around what is kept.
    """
    groups, state = straight.groups, free.adjustment.state
    moved = np.append(state.log_focal - straight.adjustment.state.log_focal, np.full(LENS_SIZE, np.nan))
    std, left_out = (
        np.fmax(kept, np.hypot(opened, moved))
        for kept, opened in ((straight.std, free.std), (straight.left_out, free.left_out))
    )
    known = straight.known and _largest(std, left_out, groups) < _OPEN_FOCAL_STD
    return replace(straight, std=std, left_out=left_out, known=known)


def _concluded(
    best: _Solution, guess: Lens, first_focal: tuple[Array, float], options: Options, *, held: bool
) -> LensEstimate:
    """The lens that counts: the solution where it is determined and sound, else the guess or a mean of both.

    Args:
        first_focal: see `estimate_lens`; held: whether the focal lengths are known.
    """
    lens, sigma = best.lens, best.adjustment.sigma
    focal_std, shape_std = best.deviations
    focal_std = np.zeros(best.groups) if held else focal_std
    logger.info("focal length %s pixels within %s %%, guess %s", lens.focal, 100 * focal_std, guess.focal)
    misfit = sigma if sigma > _MISFIT * options.polish.doubtful_px else 0.0
    sound = not misfit and np.abs(np.log(lens.focal / guess.focal)).max() <= np.log(_LARGEST_RATIO)
    contradicted = _contradicted(lens.focal, focal_std, first_focal) if sound and not held else 0.0
    if best.known and sound:
        return LensEstimate(lens, focal_std, shape_std, misfit, determined=True, contradicted_px=contradicted)
    # In a long valley a standard deviation says little.
    counts = sound and float(best.std[: best.groups].max()) < GIVEN_FOCAL_STD
    focal, rough = _kept_focal(lens.focal, focal_std, first_focal, counts=bool(counts))
    if not best.moves and sound and float(focal_std.max()) < _TURNING_STD:
        focal, rough = lens.focal, True
    if not rough:
        shape_std = np.full(LENS_SIZE, np.nan)
    final = Lens(focal, lens.shape if rough else guess.shape)
    return LensEstimate(
        final, focal_std, shape_std, misfit, determined=False, rough=rough, contradicted_px=contradicted
    )  # fmt: skip


def _settled(
    adjustment: BundleAdjustment, best: _Solution, estimate: LensEstimate, start: State, options: Options
) -> BundleAdjustment:
    """The cameras at their best for the lens that counts, which is held.

    Args:
        adjustment: converged with the guess; start: of the solution `best`.
    """
    state, errors = adjustment.state, adjustment.errors
    if estimate.determined or estimate.rough:
        state = best.adjustment.state if best.moves else through(start, best.lens.focal)
        errors = ErrorModel(best.adjustment.sigma)
    settled = BundleAdjustment(
        _seen_through(state, estimate.lens), adjustment.observations, options.polish, errors
    )  # fmt: skip
    settled.solve()
    return settled


# --- numbers ----------------------------------------------------------------------------------------------------


def _largest(std: Array, left_out: Array, groups: int) -> float:
    """Standard deviation of the focal length that is known worst."""
    return float(np.fmax(std, left_out)[:groups].max())


def _kept_focal(found: Array, std: Array, first: tuple[Array, float], *, counts: bool) -> tuple[Array, bool]:
    """(g,) focal lengths where the shot does not determine them, and whether the solution takes part in them.

    Where the solution counts, and is more certain than the first guess, they are means of the logarithms of both, each
    weighted by its inverse variance; else the first guess.
    """
    focal, first_std = first
    if not counts or float(std.max()) >= first_std:
        return focal, False
    share = first_std**2 / (first_std**2 + std**2)
    return np.asarray(found**share * focal ** (1.0 - share)), True


def _contradicted(found: Array, std: Array, first: tuple[Array, float]) -> float:
    """The first focal length, pixels, where it is more than a guess and the shot says another one; else 0."""
    focal, first_std = first
    off = np.abs(np.log(found / focal)) > _CONTRADICTION * np.hypot(std, first_std)
    return float(np.median(focal)) if 0.0 < first_std <= GIVEN_FOCAL_STD and bool(off.all()) else 0.0


def _displacement(adjustment: BundleAdjustment, guess: Array) -> float:
    """By how much the shape moves the outermost observations against the guess (pixels)."""
    o, state = adjustment.observations, adjustment.state
    xy = state.normalized(o)
    moved = state.focal[o.frame, None] * (distort(xy, state.lens)[0] - distort(xy, guess)[0])
    return float(np.percentile(np.linalg.norm(moved, axis=1), 99))
