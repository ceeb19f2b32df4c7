"""The depth prior as terms of the adjustment: its values at observations, and its affines and its error field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Term
from factorsfm.adjustment.marginals import tangent_basis
from factorsfm.adjustment.observations import PriorObservations
from factorsfm.adjustment.residuals import affine_inverse_depth, by_pose, cauchy
from factorsfm.adjustment.state import State

Array = NDArray[np.float64]


class DepthTerm:
    """Residuals of the prior's values, in standard deviations, with a Cauchy kernel."""

    def __init__(self, prior: PriorObservations, kernel: float) -> None:
        self._prior, self._kernel = prior, kernel

    def residual(self, state: State) -> Array:
        """(m,) residuals."""
        return self._predicted(state)[0]

    def cost(self, state: State) -> float:
        """Robust cost."""
        return float(cauchy(self.residual(state)[:, None], self._kernel)[0].sum())

    def linearized(self, state: State, *, cameras: bool = True) -> Term:
        """The weighted residuals and their derivatives at a state; those by the cameras only where they are wanted."""
        p = self._prior
        value, by_z, by_w, q, prediction = self._predicted(state)
        weight = np.sqrt(cauchy(value[:, None], self._kernel)[1])
        by_z, by_w = by_z * weight, by_w * weight
        along = np.einsum("mi,mij->mj", state.rotation[p.frame, 2], tangent_basis(state.bearing)[p.point])
        by_point = np.column_stack([by_z[:, None] * along, by_z * state.translation[p.frame, 2] + by_w])
        by_camera, columns = np.empty((len(q), 0)), np.empty((len(q), 0), np.int64)
        if cameras:
            by_camera = self._by_camera(state, by_z, q, prediction, weight / p.sigma)
            columns = self._columns(state)
        return Term(
            (value * weight)[None],
            np.ascontiguousarray(by_camera.T)[:, None],
            columns,
            np.ascontiguousarray(by_point.T)[:, None],
            p.frame,
            p.point,
        )

    def _by_camera(self, state: State, by_z: Array, q: Array, prediction: Array, unit: Array) -> Array:
        """(m, c) derivatives of the weighted residuals by what `_columns` names; `unit`: (m,) weights of the values."""
        p, along_z = self._prior, np.zeros((len(q), 3))
        along_z[:, 2] = by_z
        by_affine = np.stack([prediction * unit, unit], -1)
        by_field = (state.scale[p.image] * unit)[:, None] * p.node_weights
        return np.concatenate([by_pose(along_z, q, state.inverse_distance[p.point]), by_affine, by_field], 1)

    def _columns(self, state: State) -> NDArray[np.int64]:
        """(m, c) camera-side variables of each value: pose, affine and nodes of the field."""
        p, columns = self._prior, Columns.of(state)
        affine = columns.affines.start + 2 * p.image[:, None] + np.arange(2)
        return np.concatenate([columns.pose(p.frame), affine, columns.field.start + p.nodes], 1)

    def _predicted(self, state: State) -> tuple[Array, Array, Array, Array, Array]:
        """Residuals, their derivatives by depth and inverse distance, points in the cameras, predictions."""
        p = self._prior
        q = state.camera_points(p.frame, p.point)
        q[:, 2] = np.maximum(q[:, 2], 1e-6)
        w = state.inverse_distance[p.point]
        scale, smooth = state.scale[p.image], (state.field[p.nodes] * p.node_weights).sum(1)
        residual, by_z, by_w = affine_inverse_depth(q, w, scale, state.shift[p.image], p.inverse_depth)
        return (residual + scale * smooth) / p.sigma, by_z / p.sigma, by_w / p.sigma, q, w / q[:, 2] + smooth


class AffinePrior:
    """What is known beforehand of the prior's scales, shifts and error field (a `CameraTerm`)."""

    def __init__(self, prior: PriorObservations) -> None:
        self._prior = prior

    def cost(self, state: State) -> float:
        p = self._prior
        cost = 0.5 * state.field @ p.field_information @ state.field
        cost += 0.5 * (((state.scale - 1.0) / p.scale_sigma) ** 2).sum()
        return float(cost + 0.5 * ((state.shift / p.shift_sigma) ** 2).sum())

    def add(self, state: State, information: Array, gradient: Array) -> None:
        p, columns, diagonal = self._prior, Columns.of(state), np.einsum("ii->i", information)
        diagonal[columns.scales] += p.scale_sigma**-2.0
        diagonal[columns.shifts] += p.shift_sigma**-2.0
        gradient[columns.scales] += p.scale_sigma**-2.0 * (state.scale - 1.0)
        gradient[columns.shifts] += p.shift_sigma**-2.0 * state.shift
        information[columns.field, columns.field] += p.field_information
        gradient[columns.field] += p.field_information @ state.field
