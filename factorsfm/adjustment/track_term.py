"""The observations of tracks as a term of the adjustment: reprojection residuals and their linearisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Term
from factorsfm.adjustment.marginals import tangent_basis
from factorsfm.adjustment.observations import DISTORTION, READOUT, Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.residuals import by_lens_rows, by_pose_rows, cauchy, projected_rows
from factorsfm.adjustment.state import State

Array = NDArray[np.float64]
Linear = tuple[Array, Array, Array, Array, Array]

_NEAREST = 1e-6  # depth of a homogeneous point in front of the camera


class TrackTerm:
    """Reprojection residuals, in standard deviations; points behind a camera keep a large one, and no derivative.

    Inside, all components are rows of their own, with which numpy is several times faster.

    Args:
        kernel: scale of the Cauchy kernel, where the errors are independent.
        focal, lens: whether focal lengths are variables, and (6,) which part of the lens is.
    """

    def __init__(
        self,
        state: State,
        observations: Observations,
        errors: ErrorModel,
        kernel: float,
        *,
        focal: bool,
        lens: NDArray[np.bool_],
    ) -> None:
        self._observations, self._errors, self._kernel = observations, errors, kernel
        self._group = state.group[observations.frame]
        self._focal_is_free, self._lens = focal, np.flatnonzero(lens)
        columns, free = Columns.of(state), [np.zeros((len(self._group), 0), np.int64)]
        if focal:
            free.append(columns.log_focal.start + self._group[:, None])
        free.append(np.broadcast_to(columns.lens.start + self._lens, (len(self._group), len(self._lens))))
        self._columns = np.concatenate([columns.pose(observations.frame), *free], 1)
        self._known: tuple[State, Linear] | None = None  # of the last cost, whose derivatives are next

    def residual(self, state: State) -> Array:
        """(m, 2) residuals."""
        return self._linear(state)[0].T

    def costs(self, state: State) -> Array:
        """(m,) robust cost of each observation as if errors were independent; noise alone costs about one."""
        return cauchy(self.residual(state), self._kernel)[0]

    def cost(self, state: State) -> float:
        """Robust cost, with what the model of the errors says of how far they repeat each other."""
        self._known = state, self._linear(state)
        residual = self._known[1][0].T
        if self._errors.tracks is None:
            return float(cauchy(residual, self._kernel)[0].sum())
        return self._errors.tracks.cost(residual)

    def linearized(self, state: State, *, cameras: bool = True) -> Term:
        """The weighted residuals and their derivatives at a state; those by the cameras only where they are wanted."""
        o, errors = self._observations, self._errors.tracks
        known, self._known = self._known, None
        linear = known[1] if known is not None and known[0] is state else self._linear(state)
        residual, by_q, q, turn, shift = linear
        weight = np.sqrt(cauchy(residual.T, self._kernel)[1]) if errors is None else errors.root_weight
        by_q *= weight
        columns = self._columns if cameras else self._columns[:, :0]
        by_camera = np.empty((columns.shape[1], 2, len(weight)))
        if cameras:
            by_camera[:6] = by_pose_rows(by_q, q, state.inverse_distance[o.point])
        if len(by_camera) > 6:
            self._add_optics(by_camera[6:], state, residual, q)
            by_camera[6:] *= weight
        tangent = np.ascontiguousarray(tangent_basis(state.bearing).transpose(1, 2, 0)).take(o.point, axis=2)
        by_point = np.empty((3, 2, len(weight)))
        np.einsum("idm,ijm->jdm", by_q, np.einsum("ikm,kjm->ijm", turn, tangent), out=by_point[:2])
        np.einsum("idm,im->dm", by_q, shift, out=by_point[2])
        residual *= weight
        return Term(
            residual if errors is None else errors.decorrelated(residual),
            by_camera,
            columns,
            by_point,
            o.frame,
            o.point,
            errors,
        )

    def _linear(self, state: State) -> Linear:
        """(2, m) residuals, their derivative (3, 2, m) by the points in the cameras, these (3, m), and the cameras:
        rotations (3, 3, m) and translations (3, m)."""
        o, sigma = self._observations, self._errors.sigma
        turn = np.ascontiguousarray(state.rotation.transpose(1, 2, 0)).take(o.frame, axis=2)
        shift = np.ascontiguousarray(state.translation.T).take(o.frame, axis=1)
        bearing = np.ascontiguousarray(state.bearing.T).take(o.point, axis=1)
        q = np.einsum("ijm,jm->im", turn, bearing)
        q += shift * state.inverse_distance[o.point]
        behind = q[2] <= _NEAREST
        q[2, behind] = _NEAREST
        lens = state.lens if len(self._lens) or state.lens[DISTORTION].any() else None
        residual, by_q = projected_rows(q, self._focal(state), lens)
        residual -= self._observed(state).T
        by_q[:, :, behind] = 0.0
        residual /= sigma
        by_q /= sigma
        return residual, by_q, q, turn, shift

    def _focal(self, state: State) -> Array:
        """(m,) focal length of each observation, pixels; (1,) where all have the same."""
        focal = np.exp(state.log_focal)
        return np.asarray(focal if len(focal) == 1 else focal[self._group])

    def _observed(self, state: State) -> Array:
        """(m, 2) where each point would be seen if the whole image were read at once, pixels."""
        return self._observations.pixels - self._observations.swept(state.lens[READOUT])

    def _add_optics(self, rows: Array, state: State, residual: Array, q: Array) -> None:
        """Fill (c, 2, m) with the derivatives of the residuals by focal length and lens, as far as they are free."""
        o, sigma, front = self._observations, self._errors.sigma, q[2] > _NEAREST
        if self._focal_is_free:  # d r / d log f is the prediction
            rows[0] = front * (residual + self._observed(state).T / sigma)
        shape, readout = np.split(self._lens, [np.searchsorted(self._lens, READOUT.start)])
        if len(shape):
            by_shape = rows[len(rows) - len(self._lens) :][: len(shape)]
            np.multiply(by_lens_rows(q[:2] / q[2])[shape], front * self._focal(state) / sigma, out=by_shape)
        if len(readout):
            rows[-len(readout) :] = 0.0
            if o.sweep is not None:
                by_readout = o.sweep.by_readout(state.lens[READOUT]).transpose(2, 1, 0)
                np.divide(by_readout[readout - READOUT.start], sigma, out=rows[-len(readout) :])
