"""Cameras, points and lens solved together, at the noise that the residuals show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free, Known, LensPrior
from factorsfm.adjustment.some_frames import on_some_frames
from factorsfm.adjustment.state import State
from factorsfm.motion.shot_kind import CLEAR_GAIN, LEAST_GAIN, classify_motion, translation_gain
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]

_TURNING_TOLERANCE = 1e-3  # a gain is compared, not a lens found


class NotInvertibleError(Exception):
    """Some pixels are seen by no ray of a lens."""


@dataclass(frozen=True, slots=True)
class LensSolver:
    """Solves for a lens from the same observations, with the same options and the same prior on the focal lengths."""

    observations: Observations
    options: PolishOptions
    focal_prior: FocalPrior | None = None

    def solved(self, state: State, sigma: float, sigmas: Array, *, moves: bool = True) -> BundleAdjustment:
        """Converged over the lens too, first at the given noise, then at that of the residuals.

        Args:
            sigma: of the observations, pixels; sigmas: (6,) prior standard deviations of the shape around that of the
                state; moves: whether the translation is free.

        Raises:
            NotInvertibleError: a lens on the way has no ray for some of the pixels.
        """
        for _ in range(2):
            problem = self._problem(state, sigma, sigmas, moves)
            state = problem.solve()
            sigma = coordinate_sigma(problem.reprojection_errors())
        return self._problem(state, sigma, sigmas, moves)

    def solved_as_it_moves(
        self, state: State, sigma: float, sigmas: Array, *, moves: bool = True
    ) -> tuple[BundleAdjustment, bool]:
        """As `solved`, and whether the camera moves: a false translation would bend together with the lens."""
        best = self.solved(state, sigma, sigmas, moves=moves)
        if not moves:
            return best, False
        known_lens = BundleAdjustment(best.state, self.observations, self.options, best.errors)
        if self._turning(on_some_frames(known_lens), sigmas, CLEAR_GAIN) is None:
            return best, True
        turning = self._turning(known_lens, sigmas, LEAST_GAIN)
        if turning is None:
            return best, True
        return self.solved(turning, best.sigma, sigmas, moves=False), False

    def _turning(self, known_lens: BundleAdjustment, sigmas: Array, least: float) -> State | None:
        """A camera that only turns, None where translation gains at least this much."""
        motion = classify_motion(known_lens, self.options)
        if motion.gain <= least:
            return motion.rotation_only
        if not sigmas.any():
            return None
        rotating = BundleAdjustment(  # a lens may have bent to fit a false translation: let it do without
            motion.rotation_only, known_lens.observations, replace(self.options, tolerance=_TURNING_TOLERANCE),
            known_lens.errors, free=Free(translation=False, focal=True),
            known=Known(self.focal_prior, LensPrior(motion.rotation_only.lens, sigmas)),
        )  # fmt: skip
        rotating.solve()
        return motion.rotation_only if translation_gain(rotating, known_lens) <= least else None

    def _problem(self, state: State, sigma: float, sigmas: Array, moves: bool) -> BundleAdjustment:
        check_invertible(state, self.observations)
        lens = LensPrior(state.lens, sigmas) if sigmas.any() else None
        return BundleAdjustment(
            state, self.observations, self.options, ErrorModel(sigma),
            free=Free(translation=moves, focal=True), known=Known(self.focal_prior, lens),
        )  # fmt: skip


def check_invertible(state: State, observations: Observations) -> None:
    """Insist that the lens of a state has a ray for every observation.

    Raises:
        NotInvertibleError: it has none for some of them.
    """
    if not np.isfinite(state.normalized(observations)).all():
        raise NotInvertibleError
