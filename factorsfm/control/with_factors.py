"""From the free solution to the one that respects factors of the caller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import Free, Known
from factorsfm.adjustment.state import State
from factorsfm.control.factor_term import FactorTerm
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.control.residuals import SCALE_STD, MarkItem, Place
from factorsfm.control.solve import Controlled, described, options_under_control
from factorsfm.control.solved_control import triangulated
from factorsfm.control.start import KERNEL
from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.support.rotations import camera_centers

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ShotFactors:
    """Factors of the caller on a shot, in the world of its live map.

    Attributes:
        frames: positions of the frames that they name; tracks: (t,) the landmarks.
        poses: `cam_from_world` rotation and translation in the live map, by position.
        on_poses: makes them a function of the poses at some positions, of some of the tracks, and of the affines at
            other positions.
    """

    frames: list[int]
    tracks: Index
    poses: dict[int, tuple[Array, Array]]
    on_poses: Callable[[Sequence[int], Sequence[int], Sequence[int]], FactorsOnPoses]


def solve_with_factors(
    adjustment: BundleAdjustment, factors: ShotFactors, marks: Observations, frames: list[int], guided: list[int]
) -> Controlled:
    """Solve once more, with the factors.

    Args:
        adjustment: the free solution; marks: observations of the tracks (rows in `factors.tracks`) in its frames.
        frames: position of each of its frames in the source; guided: of those with an affine.
    """
    state = adjustment.state
    places = triangulated(state, marks, np.bincount(marks.point, minlength=len(factors.tracks)))
    placed = np.flatnonzero(np.isfinite(places[:, 0]))
    marks, places = marks.of(placed), places[placed]
    rotation, anchor, shift, scale = _alignment(state, factors, frames)
    state = replace(state, control=np.concatenate([np.zeros(3), shift, [np.log(scale)], places.ravel()]))
    on_poses = factors.on_poses(frames, factors.tracks[placed].tolist(), guided)
    term = FactorTerm(on_poses, _items(marks, adjustment.sigma), rotation, anchor, KERNEL, state)
    solved = BundleAdjustment(
        state, adjustment.observations, options_under_control(adjustment.options), adjustment.errors,
        prior=adjustment.prior, free=Free(held=np.arange(len(frames)) == 0), known=Known(control=term),
    )  # fmt: skip
    solved.solve()
    residuals = [ControlResidual.of(name, "sigma", 1.0, error) for name, error in term.errors(solved.state)]
    unused = [f"what is known of {name}, since the depth of its frame takes no part" for name in on_poses.loose]
    controlled = described(solved, term, lambda scale_std, position_std: ControlFit(
        residuals, [], unused, placed=True, scale_std=scale_std, position_std=position_std, source="factors",
    ))  # fmt: skip
    agreeing = [row for row, residual in enumerate(residuals) if not residual.contradicts]
    known = term.determines_scale and controlled.fit.scale_std < SCALE_STD
    return controlled if known and term.agree_on_scale(solved.state, agreeing) else controlled.without_unit()


def _alignment(state: State, factors: ShotFactors, frames: list[int]) -> tuple[Array, Array, Array, float]:
    """Rotation and anchor of the alignment to the live map, where the anchor is there, and the scale."""
    known = [row for row, position in enumerate(frames) if position in factors.poses]
    live = [factors.poses[frames[row]] for row in known]
    centers = camera_centers(state.rotation[known], state.translation[known])
    live_centers = camera_centers(np.array([turn for turn, _ in live]), np.array([shift for _, shift in live]))
    away, live_away = centers - centers[0], live_centers - live_centers[0]
    scale = float(np.linalg.norm(live_away)) / max(float(np.linalg.norm(away)), 1e-12)
    rotation = live[0][0].T @ state.rotation[known[0]]
    return rotation, centers[0], live_centers[0], scale if np.isfinite(scale) and scale > 0.0 else 1.0


def _items(marks: Observations, sigma: float) -> list[MarkItem]:
    return [
        MarkItem(f"landmark {point}", row, Place(point), pixels, sigma)
        for row, point, pixels in zip(marks.frame.tolist(), marks.point.tolist(), marks.pixels, strict=True)
    ]
