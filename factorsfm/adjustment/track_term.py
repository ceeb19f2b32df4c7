"""The observations of tracks as a term of the adjustment: reprojection residuals and their linearisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Term
from factorsfm.adjustment.marginals import tangent_basis
from factorsfm.adjustment.observations import DISTORTION, READOUT, Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.residuals import by_pose, cauchy, distort, reprojection
from factorsfm.adjustment.state import State

Array = NDArray[np.float64]

_NEAREST = 1e-6  # depth of a homogeneous point in front of the camera


class TrackTerm:
    """Reprojection residuals, in standard deviations; points behind a camera keep a large one, and no derivative.

    Args:
        kernel: scale of the Cauchy kernel, where the errors are independent.
        focal, lens: whether focal lengths and lens are variables.
    """

    def __init__(
        self, state: State, observations: Observations, errors: ErrorModel, kernel: float, *, focal: bool, lens: bool
    ) -> None:
        self._observations, self._errors, self._kernel = observations, errors, kernel
        self._columns = Columns.of(state)
        self._group = state.group[observations.frame]
        self._optics, self._lens = focal or lens, lens

    def residual(self, state: State) -> tuple[Array, Array, Array]:
        """(m, 2) residuals, their derivative (m, 2, 3) by the points in the cameras, and these (m, 3)."""
        o = self._observations
        q = state.camera_points(o.frame, o.point)
        behind = q[:, 2] <= _NEAREST
        q[behind, 2] = _NEAREST
        lens = state.lens if self._lens or state.lens[DISTORTION].any() else None
        residual, by_q = reprojection(q, self._observed(state), self._focal(state), lens)
        by_q[behind] = 0.0
        return residual / self._errors.sigma, by_q / self._errors.sigma, q

    def costs(self, state: State) -> Array:
        """(m,) robust cost of each observation as if errors were independent; noise alone costs about one."""
        return cauchy(self.residual(state)[0], self._kernel)[0]

    def cost(self, state: State) -> float:
        """Robust cost, with what the model of the errors says of how far they repeat each other."""
        if self._errors.tracks is None:
            return float(self.costs(state).sum())
        return self._errors.tracks.cost(self.residual(state)[0])

    def linearized(self, state: State) -> Term:
        """The weighted residuals and their derivatives at a state."""
        o, errors = self._observations, self._errors.tracks
        residual, by_q, q = self.residual(state)
        weight = np.sqrt(cauchy(residual, self._kernel)[1]) if errors is None else errors.root_weight
        gain = np.ascontiguousarray((by_q * weight[:, None, None]).transpose(1, 0, 2))
        by_camera, columns = by_pose(gain, q, state.inverse_distance[o.point]), self._columns.pose(o.frame)
        if self._optics:
            by_optics, optics = self._by_optics(state, residual, q)
            by_camera = np.concatenate([by_camera, (by_optics * weight[:, None, None]).transpose(1, 0, 2)], 2)
            columns = np.concatenate([columns, optics], 1)
        by_bearing = state.rotation[o.frame] @ tangent_basis(state.bearing)[o.point]
        by_point = gain.transpose(1, 0, 2) @ np.concatenate([by_bearing, state.translation[o.frame][:, :, None]], 2)
        weighted = (residual * weight[:, None]).T
        return Term(
            weighted if errors is None else errors.decorrelated(weighted),
            np.ascontiguousarray(by_camera.transpose(2, 0, 1)),
            columns,
            np.ascontiguousarray(by_point.transpose(2, 1, 0)),
            o.frame,
            o.point,
            errors,
        )

    def _focal(self, state: State) -> Array:
        """(m,) focal length of each observation, pixels; (1,) where all have the same."""
        focal = np.exp(state.log_focal)
        return np.asarray(focal if len(focal) == 1 else focal[self._group])

    def _observed(self, state: State) -> Array:
        """(m, 2) where each point would be seen if the whole image were read at once, pixels."""
        return self._observations.pixels - self._observations.swept(state.lens[READOUT])

    def _by_optics(self, state: State, residual: Array, q: Array) -> tuple[Array, NDArray[np.int64]]:
        """(m, 2, c) derivative of the residuals by focal length and lens of each observation, and (m, c) columns."""
        o, sigma = self._observations, self._errors.sigma
        front = (q[:, 2] > _NEAREST)[:, None, None]
        by_focal = front * (residual + self._observed(state) / sigma)[:, :, None]  # d r / d log f is the prediction
        focal_columns = self._columns.log_focal.start + self._group[:, None]
        if not self._lens:
            return by_focal, focal_columns
        by_lens = distort(q[:, :2] / q[:, 2:], state.lens)[2]
        by_lens *= front * (self._focal(state) / sigma)[:, None, None]
        by_readout = np.zeros((len(q), 2, 2))
        if o.sweep is not None:
            by_readout = o.sweep.by_readout(state.lens[READOUT]) / sigma
        lens_columns = np.broadcast_to(np.arange(self._columns.size)[self._columns.lens], (len(q), 6))
        return np.concatenate([by_focal, by_lens, by_readout], 2), np.concatenate([focal_columns, lens_columns], 1)
