"""The incremental factor graph: keyframe poses and prior affines in iSAM2, the landmarks condensed into one factor.

In shots with little parallax every keyframe sees every landmark, and a general solver eliminates nearly all of them
again at every update (60 keyframes: half a second). So the landmarks never become variables of iSAM2. Their
observations and depth-consistency residuals are linearised in numpy, the landmarks eliminated, and what they say of
the keyframes enters as one container factor, which each step replaces by its slot; iSAM2 forgets the variables of
keyframes that have left the window, and gives the covariances of the others.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, F, X
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.state import State
from factorsfm.graph.factors import pose_from_camera

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_LARGEST_ERROR_PX = 10.0
_LEAST_IN_FRONT = 0.7
_MIRRORED = "the depth is mirrored: the scale of a prior is negative"


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Outcome of an update: committed or rolled back, and why.

    Attributes:
        covariance: (6, 6) of the pose of each free keyframe, by position (`FrameResult.covariance`).
        mirrored: whether it was rolled back because the solution and the prior are each other's mirror image.
    """

    committed: bool
    reason: str
    covariance: dict[int, Array]
    mirrored: bool = False


class FactorGraph:
    """Poses X(position) and affines A(position) of the keyframes.

    Every update runs on a copy and is committed only if the result is finite, in front of the cameras and not
    mirrored; a failed iSAM2 object is never used again.
    """

    def __init__(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.0)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        self._slots: list[int] = []  # of the landmarks' factor

    def update(
        self,
        adjustment: BundleAdjustment,
        positions: Sequence[int],
        guided: Sequence[int],
        iterations: int,
    ) -> UpdateResult:
        """Solve for the keyframes of a window and their landmarks; `adjustment.state` is the result if it commits.

        Args:
            adjustment: the problem of the window.
            positions: identity of each of its frames; those that it holds are constant.
            guided: positions of the frames that carry a depth prior, in the order of their affines.
            iterations: steps at most.
        """
        free = [(row, p) for row, p in enumerate(positions) if not adjustment.held[row]]
        trial = _Trial(gtsam.ISAM2(self._isam), self._slots, free, guided)
        before, covariance = adjustment.state, {}
        try:
            reason = "the keyframe observes no landmark" if adjustment.held[-1] else ""
            if not reason:
                adjustment.solve(iterations, trial.step)
                reason = _fault(adjustment)
            if not reason:
                trial.step(adjustment.state, *adjustment.condensed())  # the covariances are those without damping
                covariance = {p: np.asarray(trial.isam.marginalCovariance(X(p))) for _, p in free}
        except Exception as error:  # gtsam raises several types; any of them leaves the trial unusable
            message = (str(error).strip() or repr(error)).splitlines()[0]
            reason = f"the linear system of the update is indeterminate ({message})"
        if reason:
            logger.warning("update at frame %d rolled back: %s", positions[-1], reason)
            adjustment.state = before
            return UpdateResult(False, reason, {}, reason == _MIRRORED)
        self._isam, self._slots = trial.isam, trial.slots
        return UpdateResult(True, "committed", covariance)


class _Trial:
    """A copy of iSAM2 that takes the steps of one update."""

    def __init__(self, isam: gtsam.ISAM2, slots: list[int], free: list[tuple[int, int]], guided: Sequence[int]) -> None:
        self.isam, self.slots = isam, slots
        self._rows = [row for row, _ in free]
        self._poses = [X(p) for _, p in free]
        self._affines = [A(p) for p in guided]
        self.keys = [*self._poses, *self._affines, *([F(0)] if guided else [])]

    def step(self, state: State, information: Array, gradient: Array) -> Array:
        """The cameras' step from `state`: the condensed landmarks replace those of the step before."""
        point = self._values(state)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.LinearContainerFactor(self._condensed(information, gradient), point))
        known = self.isam.getLinearizationPoint()
        new = gtsam.Values(point)
        for key in self.keys:
            if known.exists(key):
                new.erase(key)
        result = self.isam.update(graph, new, self.slots)
        self.slots = [int(result.getNewFactorsIndices()[0])]
        estimate = self.isam.calculateEstimate()
        poses = [point.atPose3(key).localCoordinates(estimate.atPose3(key)) for key in self._poses]
        vectors = [estimate.atVector(key) - point.atVector(key) for key in self.keys[len(self._poses) :]]
        return np.concatenate([*poses, *vectors])

    def _values(self, state: State) -> gtsam.Values:
        values = gtsam.Values()
        for key, row in zip(self._poses, self._rows, strict=True):
            values.insert(key, pose_from_camera(state.rotation[row], state.translation[row]))
        for key, scale, shift in zip(self._affines, state.scale, state.shift, strict=True):
            values.insert(key, np.array([scale, shift]))
        if self._affines:
            values.insert(F(0), state.field)
        return values

    def _condensed(self, information: Array, gradient: Array) -> gtsam.HessianFactor:
        """A quadratic on all variables at once; the binding builds it from its pairs."""
        size = len(gradient) - 6 * len(self._poses) - 2 * len(self._affines)
        sizes = [6] * len(self._poses) + [2] * len(self._affines) + [size] * bool(self._affines)
        ends = np.cumsum(sizes)
        spans = [slice(end - n, end) for end, n in zip(ends.tolist(), sizes, strict=True)]
        zero = {(n, m): np.zeros((n, m)) for n in set(sizes) for m in (*set(sizes), 1)}
        pairs = gtsam.GaussianFactorGraph()
        for i, (key, a) in enumerate(zip(self.keys, spans, strict=True)):
            pairs.add(gtsam.HessianFactor(key, information[a, a], -gradient[a], 0.0))
            mine = sizes[i]
            for other, b, n in zip(self.keys[i + 1 :], spans[i + 1 :], sizes[i + 1 :], strict=True):
                pairs.add(
                    gtsam.HessianFactor(
                        key, other, zero[mine, mine], information[a, b], zero[mine, 1], zero[n, n], zero[n, 1], 0.0
                    )
                )
        return gtsam.HessianFactor(pairs)


def _fault(adjustment: BundleAdjustment) -> str:
    """What speaks against a result, judged at its newest frame; empty if nothing does."""
    state, o = adjustment.state, adjustment.observations
    newest = len(state.rotation) - 1
    if not (np.isfinite(state.rotation).all() and np.isfinite(state.translation).all()):
        return "the pose is not finite"
    mine = o.frame == newest
    depth = state.camera_points(o.frame[mine], o.point[mine])[:, 2]
    front = depth > 1e-6
    if front.mean() < _LEAST_IN_FRONT:
        return f"{int((~front).sum())} of {len(front)} landmarks lie behind the camera"
    error = float(np.median(adjustment.reprojection_errors()[mine]))
    if not error < _LARGEST_ERROR_PX:
        return f"the median reprojection error is {error:.1f} pixels, at most {_LARGEST_ERROR_PX:.0f} expected"
    if (state.scale <= 0.0).any():
        return _MIRRORED
    return ""
