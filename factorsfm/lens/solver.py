"""Cameras, points and lens solved together, at the noise that the residuals show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, FocalPrior, Free, Known, LensPrior
from factorsfm.adjustment.state import State
from factorsfm.motion.shot_kind import LEAST_GAIN, classify_motion, translation_gain
from factorsfm.support.options import PolishOptions
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]


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
        motion = classify_motion(known_lens, self.options)
        general = motion.kind is ShotKind.GENERAL
        if general and sigmas.any():  # a lens may have bent to fit a false translation: let it do without
            rotating = BundleAdjustment(
                motion.rotation_only, self.observations, self.options, best.errors,
                free=Free(translation=False, focal=True),
                known=Known(self.focal_prior, LensPrior(motion.rotation_only.lens, sigmas)),
            )  # fmt: skip
            rotating.solve()
            general = translation_gain(rotating, known_lens) > LEAST_GAIN
        if general:
            return best, True
        return self.solved(motion.rotation_only, best.sigma, sigmas, moves=False), False

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
