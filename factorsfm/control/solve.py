"""From the free solution to the one under control: everything in one adjustment, and its covariances."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import pose_covariances
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import Free, Known
from factorsfm.adjustment.shared_errors import in_scene_unit_with, shared_errors
from factorsfm.adjustment.state import State
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.control.located import LocatedControl
from factorsfm.control.residuals import AlignedState, ControlTerm, Item
from factorsfm.control.solved_control import SolvedControl
from factorsfm.control.start import KERNEL, check_size, start_under_control, wide_kernel
from factorsfm.support.options import PolishOptions
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_STEPS, _TOLERANCE = 25, 2e-5
_POINT_STEPS = 5  # of the points alone, after cameras were put where they are held
_POINT_SIGMA = 5.0  # a weak prior of the points: the control may change the shape of the scene


@dataclass(frozen=True, slots=True)
class Controlled:
    """The solution under control.

    Attributes:
        adjustment: at its minimum, in the world of the polish.
        world_alignment: from that to the world of the control; None where this has no unit of its own.
        covariance: (k, 6, 6) of the poses in the control's world, in the polish's unit of length;
            relative_covariance: of each pose relative to the one before.
        camera_covariance: (c, c) of the camera side relative to the scene's unit; point_std: (n,) of the inverse
            distances.
    """

    adjustment: BundleAdjustment
    world_alignment: Similarity | None
    covariance: Array
    relative_covariance: Array
    camera_covariance: Array
    point_std: Array
    fit: ControlFit

    def without_unit(self) -> Controlled:
        """The same where nothing that agrees with the images knows lengths."""
        return replace(self, world_alignment=None, fit=replace(self.fit, placed=False, scale_std=np.inf))


def solve_under_control(
    adjustment: BundleAdjustment, located: LocatedControl, marks: Observations, frames: list[int]
) -> Controlled:
    """Solve once more, with all control at its sigma.

    Args:
        adjustment: the free solution; marks: of all points of the control in its frames.
        frames: position of each of its frames in the source.

    Raises:
        ReconstructionError: the control of the registered frames does not determine where the scene is, or contradicts
            the images so much that the scene vanishes.
    """
    control = SolvedControl(located, marks, frames, adjustment.state)
    state, term, held = start_under_control(control, adjustment.state)
    begin = float(state.control[6])  # log of the scale
    options = options_under_control(adjustment.options)
    if control.held:
        points_only = BundleAdjustment(
            state, adjustment.observations, options, adjustment.errors, free=Free(cameras=False)
        )
        state = points_only.solve(_POINT_STEPS)
    solved = _converged(adjustment, state, term, held, options)
    check_size(term, solved.state, begin)
    residuals = _residuals(term, solved.state)
    logger.info("control: %d items, %d contradict", len(residuals), sum(r.contradicts for r in residuals))
    exact = [control.names[row] for row, _ in control.held]
    controlled = described(
        solved, term,
        lambda scale_std, position_std: ControlFit(
            residuals, exact, control.unused, control.placed, scale_std, position_std
        ),
    )  # fmt: skip
    agreeing = [item for item, residual in zip(term.items, residuals, strict=True) if not residual.contradicts]
    return controlled if term.knows_scale(solved.state, agreeing) else controlled.without_unit()


def options_under_control(options: PolishOptions) -> PolishOptions:
    """Those of the last solution, which may change the shape of the scene."""
    return replace(options, point_sigma=_POINT_SIGMA, iterations=_STEPS, tolerance=_TOLERANCE)


def frames_under_control(registered: list[int], control: LocatedControl, limit: int) -> list[int]:
    """Registered frames that the control refers to; of very many, those that are held and some of the others."""
    held = {control.position[pose.frame] for pose in control.control.poses if pose.held}
    others = sorted({*control.position.values()} - held)
    if len(others) > limit:
        others = [others[k] for k in np.linspace(0, len(others) - 1, limit).astype(int)]
    return sorted({*held, *others} & {*registered})


def _converged(
    adjustment: BundleAdjustment, state: State, term: ControlTerm, held: NDArray[np.bool_], options: PolishOptions
) -> BundleAdjustment:
    """The joint adjustment at its minimum, first with a kernel as wide as the residuals are at the start."""
    solved = adjustment
    # At a start far away, a narrow kernel would take all control for outliers.
    for kernel in sorted({wide_kernel(term, state), KERNEL}, reverse=True):
        term.kernel = kernel
        solved = BundleAdjustment(
            state, adjustment.observations, options, adjustment.errors,
            prior=adjustment.prior, free=Free(held=held), known=Known(control=term),
        )  # fmt: skip
        state = solved.solve()
        logger.debug("control: kernel %.1f sigma, %d iterations", kernel, solved.iterations)
    return solved


# --- the result -------------------------------------------------------------------------------------------------


class AlignedTerm(Protocol):
    """A term that aligns the world of the polish with one of its own."""

    def aligned(self, state: State) -> AlignedState: ...


def described(solved: BundleAdjustment, term: AlignedTerm, fit: Callable[[float, float], ControlFit]) -> Controlled:
    """The solution with its covariances.

    Args:
        fit: of the relative standard deviation of the scale and that of a camera's position.
    """
    state, marginals = solved.state, solved.marginals()
    aligned = term.aligned(state)
    shared = shared_errors(solved, marginals)
    relative, point_std = in_scene_unit_with(shared, marginals, state, _by_size(aligned))
    covariance, relative_covariance = _pose_covariances(marginals.camera + shared.in_world(solved.held), aligned)
    log_scale = Columns.of(state).control.start + 6
    spread = aligned.scale * np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
    scale_std = float(np.sqrt(max(float(relative[log_scale, log_scale]), 0.0)))
    return Controlled(
        solved, aligned.similarity, covariance, relative_covariance, relative, point_std,
        fit(scale_std, float(np.median(spread))),
    )  # fmt: skip


def _residuals(term: ControlTerm, state: State) -> list[ControlResidual]:
    return [_residual(item, r) for item, r in zip(term.items, term.residuals(state), strict=True)]


def _residual(item: Item, residual: Array) -> ControlResidual:
    sigmas = float(np.linalg.norm(residual))
    return ControlResidual.of(item.name, item.unit, item.sigma, sigmas)


def _pose_covariances(camera: Array, aligned: AlignedState) -> tuple[Array, Array]:
    """As `pose_covariances`, from that of the camera side (c, c), of the poses in the control's world, in the polish's
    unit of length.

    A change of the world alignment turns and moves all cameras: ``R (s x) + T`` by its variables, seen from the camera.
    """
    used, derivatives = zip(*(aligned.known_pose(row) for row in range(len(aligned.state.rotation))), strict=True)
    in_polish = np.repeat([1.0, 1.0 / aligned.scale], 3)[:, None]
    return pose_covariances(camera, in_polish * np.array(derivatives), np.array(used), aligned.state)


def _by_size(aligned: AlignedState) -> Array:
    """(7 + 3 p,) by how much alignment and marked points change with the logarithm of the scene's size."""
    by_size = -aligned.state.control
    by_size[:3] = 0.0
    by_size[3:6] = aligned.scale * aligned.rotation @ aligned.anchor
    by_size[6] = 1.0
    return by_size
