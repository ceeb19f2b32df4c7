"""The batch polish: all frames and all tracks on the factors of the graph, points eliminated first.

The normal equations are those of the factor graph with the elimination order *points, then everything else*. In these
shots every camera sees every point, so what remains after the points is one dense block, which numpy solves an order
of magnitude faster than a general multifrontal solver (see benchmarks). Points are unit bearings with an inverse
distance, in which small motion is almost linear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Block, Elimination, Normal, Term, conditioned, reduced
from factorsfm.adjustment.marginals import Marginals, tangent_basis
from factorsfm.adjustment.observations import READOUT, Observations, PriorObservations
from factorsfm.adjustment.residuals import affine_inverse_depth, by_pose, cauchy, distort, reprojection
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.adjustment.track_errors import TrackErrors
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import exponential

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# The camera side's step at a state, from its information matrix and gradient with the points eliminated.
CameraSolver = Callable[[State, Array, Array], Array]

_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e6


def _newton_step(state: State, information: Array, gradient: Array) -> Array:
    return np.asarray(-np.linalg.solve(information, gradient))


class ControlTerm(Protocol):
    """What is known beforehand of poses and points, as a term of the adjustment (`control.residuals`).

    Attributes:
        free: which of the variables `State.control` are estimated.
    """

    @property
    def free(self) -> NDArray[np.bool_]: ...
    def cost(self, state: State) -> float: ...
    def add(self, state: State, information: Array, gradient: Array) -> None: ...


class BundleAdjustment:
    """Levenberg-Marquardt over poses, points, focal lengths, prior affines and the prior's smooth error field.

    Args:
        observations: sorted by point; every point has at least one.
        sigma: standard deviation of an observation (pixels).
        free_translation: False estimates rotations and bearings alone.
        free_focal: whether the focal lengths are estimated.
        focal_prior: (g,) mean and (g, g) information matrix with which the logarithms of the focal lengths are known
            beforehand; None: not at all.
        lens_sigmas: (6,) standard deviations with which `State.lens` is known beforehand (0: exactly); None: it is
            zero, the observations are undistorted. lens_mean: (6,) around what; None: around the state's.
        points_only: True holds everything but the points fixed.
        fixed: (k,) frames whose poses are held; by default the one that is the world. Those without observations are
            held as well.
        prior: depth-prior values, or None.
        control: what is known beforehand of poses and points, or None.
        track_errors: weights of the observations, and how far their errors repeat each other; the kernel then works on
            the prior alone. None: independent errors with the kernel of the options.
    """

    def __init__(
        self,
        state: State,
        observations: Observations,
        options: PolishOptions,
        *,
        sigma: float,
        free_translation: bool = True,
        free_focal: bool = False,
        focal_prior: tuple[Array, Array] | None = None,
        lens_sigmas: Array | None = None,
        lens_mean: Array | None = None,
        points_only: bool = False,
        fixed: NDArray[np.bool_] | None = None,
        prior: PriorObservations | None = None,
        control: ControlTerm | None = None,
        track_errors: TrackErrors | None = None,
    ) -> None:
        if (np.diff(observations.point) < 0).any():
            raise ValueError("observations must be sorted by point")
        self.state = state
        self.observations = observations
        self.options = options
        self.sigma = sigma
        self.prior = prior
        self.control = control
        self.track_errors = track_errors
        self.iterations = 0
        self._anchor = state.inverse_distance.copy()
        typical = float(np.median(self._anchor)) if len(self._anchor) else 0.0
        self._point_sigma = options.point_sigma * max(typical, 1e-9)
        self._focal_prior = focal_prior
        self._group = state.group[observations.frame]
        self._lens_sigmas = lens_sigmas
        self._lens_mean = state.lens if lens_mean is None else lens_mean
        seen = observations.xy if lens_sigmas is None else distort(observations.xy, state.lens)[0]
        self._pixels = seen * self._focal(state)[:, None]  # what was measured, whatever the lens
        if lens_sigmas is not None:
            self._pixels += observations.swept(state.lens[READOUT])
        self.columns = columns = Columns.of(state)
        frames = len(state.rotation)
        free = np.ones(columns.size, bool)
        held = np.arange(frames) == state.world if fixed is None else fixed
        self.held = held | (np.bincount(observations.frame, minlength=frames) == 0)  # nothing says where they are
        free[columns.poses] = np.repeat(~self.held, 6)
        free[columns.log_focal] = free_focal
        free[columns.lens] = lens_sigmas is not None and lens_sigmas > 0
        if control is not None:
            free[columns.control] = control.free
        if not free_translation:
            free[columns.poses].reshape(-1, 6)[:, 3:] = False
        self._free = np.nonzero(free & (not points_only))[0]
        self._freedom: dict[str, Any] = {
            "free_translation": free_translation, "free_focal": free_focal, "focal_prior": focal_prior,
            "lens_sigmas": lens_sigmas, "lens_mean": self._lens_mean, "fixed": held,
        }  # fmt: skip
        self._lens_is_free = free_focal or lens_sigmas is not None
        self.free_lens = np.nonzero(free[columns.optics])[0]  # rows among the log focal lengths and `State.lens`
        self._elimination = Elimination(columns.size, len(state.bearing))

    # --- residuals ----------------------------------------------------------------------------------------------

    def reprojection_errors(self) -> Array:
        """(m,) distance between observed and predicted position (pixels)."""
        return np.asarray(np.linalg.norm(self.reprojection_vectors(), axis=1))

    def reprojection_vectors(self) -> Array:
        """(m, 2) predicted minus observed position (pixels)."""
        return self._reprojection(self.state)[0] * self.sigma

    def cost(self) -> float:
        """Robust cost at the present state."""
        return self._cost(self.state)

    def observation_costs(self) -> Array:
        """(m,) robust cost of each observation; noise alone costs about one."""
        return cauchy(self._reprojection(self.state)[0], self.options.kernel)[0]

    def _focal(self, state: State) -> Array:
        """(m,) focal length of each observation, pixels; (1,) where all have the same."""
        focal = np.exp(state.log_focal)
        return np.asarray(focal if len(focal) == 1 else focal[self._group])

    def _reprojection(self, state: State) -> tuple[Array, Array, Array]:
        o, focal = self.observations, self._focal(state)
        q = state.camera_points(o.frame, o.point)
        behind = q[:, 2] <= 1e-6
        q[behind, 2] = 1e-6
        residual, by_q = reprojection(q, self._pixels, focal)
        if self._lens_sigmas is not None:
            uv, by_uv, _ = distort(q[:, :2] / q[:, 2:], state.lens)
            residual = focal[:, None] * uv - self._pixels + o.swept(state.lens[READOUT])
            by_q = by_uv @ by_q
        by_q[behind] = 0.0
        return residual / self.sigma, by_q / self.sigma, q

    def _by_lens(self, residual: Array, q: Array) -> Array:
        """(m, 2, c) derivative of the residuals by the columns of the lens: focal length of the frame, shape."""
        measured = self._pixels - self.observations.swept(self.state.lens[READOUT])
        by_focal = (residual + measured / self.sigma)[:, :, None]  # d r / d log f is the prediction
        if self._lens_sigmas is None:
            return np.asarray(by_focal)
        by_lens = distort(q[:, :2] / q[:, 2:], self.state.lens)[2]
        by_lens *= (self._focal(self.state) / self.sigma)[:, None, None]
        sweep = self.observations.sweep
        by_readout = np.zeros((len(q), 2, 2))
        if sweep is not None:
            by_readout = sweep.by_readout(self.state.lens[READOUT]) / self.sigma
        return np.concatenate([by_focal, by_lens, by_readout], 2)

    def _lens_prior(self, state: State) -> tuple[Array, Array]:
        """Differences to what is known of the lens, and the information; none of it where nothing is estimated."""
        sigmas = np.zeros(LENS_SIZE) if self._lens_sigmas is None else self._lens_sigmas
        free = sigmas > 0
        return np.where(free, state.lens - self._lens_mean, 0.0), np.where(free, sigmas, np.inf) ** -2.0

    def prior_residuals(self, state: State | None = None) -> Array:
        """(m,) residuals of the prior (unit of its inverse depth)."""
        assert self.prior is not None
        return self._prior(state or self.state)[0] * self.prior.sigma

    def _prior(self, state: State) -> tuple[Array, Array, Array, Array, Array]:
        p = self.prior
        assert p is not None
        q = state.camera_points(p.frame, p.point)
        q[:, 2] = np.maximum(q[:, 2], 1e-6)
        w = state.inverse_distance[p.point]
        scale, smooth = state.scale[p.image], (state.field[p.nodes] * p.node_weights).sum(1)
        residual, by_z, by_w = affine_inverse_depth(q, w, scale, state.shift[p.image], p.inverse_depth)
        return (residual + scale * smooth) / p.sigma, by_z / p.sigma, by_w / p.sigma, q, w / q[:, 2] + smooth

    def _cost(self, state: State) -> float:
        residual = self._reprojection(state)[0]
        if self.track_errors is None:
            cost = cauchy(residual, self.options.kernel)[0].sum()
        else:
            cost = self.track_errors.cost(residual)
        cost += 0.5 * (((state.inverse_distance - self._anchor) / self._point_sigma) ** 2).sum()
        difference, information = self._lens_prior(state)
        cost += 0.5 * (information * difference**2).sum()
        if self._focal_prior is not None:
            away = state.log_focal - self._focal_prior[0]
            cost += 0.5 * away @ self._focal_prior[1] @ away
        if (p := self.prior) is not None:
            cost += cauchy(self._prior(state)[0][:, None], self.options.kernel)[0].sum()
            cost += 0.5 * state.field @ p.field_information @ state.field
            cost += 0.5 * (((state.scale - 1.0) / p.scale_sigma) ** 2).sum()
            cost += 0.5 * ((state.shift / p.shift_sigma) ** 2).sum()
        if self.control is not None:
            cost += self.control.cost(state)
        return float(cost)

    # --- linearisation ------------------------------------------------------------------------------------------

    def _terms(self) -> list[Term]:
        s, o = self.state, self.observations
        tangent = tangent_basis(s.bearing)
        residual, by_q, q = self._reprojection(s)
        errors = self.track_errors
        weight = np.sqrt(cauchy(residual, self.options.kernel)[1]) if errors is None else errors.root_weight
        gain = np.ascontiguousarray((by_q * weight[:, None, None]).transpose(1, 0, 2))
        by_camera, columns = by_pose(gain, q, s.inverse_distance[o.point]), self.columns.pose(o.frame)
        if self._lens_is_free:
            by_lens = (self._by_lens(residual, q) * weight[:, None, None]).transpose(1, 0, 2)
            lens = self.columns.lens.start + np.arange(by_lens.shape[2] - 1)
            by_camera = np.concatenate([by_camera, by_lens], 2)
            focal = self.columns.log_focal.start + self._group[:, None]
            columns = np.concatenate([columns, focal, np.broadcast_to(lens, (len(q), len(lens)))], 1)
        by_bearing = s.rotation[o.frame] @ tangent[o.point]
        by_point = gain.transpose(1, 0, 2) @ np.concatenate([by_bearing, s.translation[o.frame][:, :, None]], 2)
        weighted = (residual * weight[:, None]).T
        terms = [
            Term(
                weighted if errors is None else errors.decorrelated(weighted),
                np.ascontiguousarray(by_camera.transpose(2, 0, 1)),
                columns,
                np.ascontiguousarray(by_point.transpose(2, 1, 0)),
                o.frame,
                o.point,
                errors,
            )
        ]
        if (p := self.prior) is not None:
            value, by_z, by_w, q, prediction = self._prior(s)
            weight = np.sqrt(cauchy(value[:, None], self.options.kernel)[1])
            by_z, by_w, unit = by_z * weight, by_w * weight, weight / p.sigma
            along_z = np.zeros((len(q), 3))
            along_z[:, 2] = by_z
            along = np.einsum("mi,mij->mj", s.rotation[p.frame, 2], tangent[p.point])
            by_point = np.column_stack([by_z[:, None] * along, by_z * s.translation[p.frame, 2] + by_w])
            by_affine = np.stack([prediction * unit, unit], -1)
            by_field = (s.scale[p.image] * unit)[:, None] * p.node_weights
            by_camera = np.concatenate([by_pose(along_z, q, s.inverse_distance[p.point]), by_affine, by_field], 1)
            affine = self.columns.affines.start + 2 * p.image[:, None] + np.arange(2)
            columns = np.concatenate([self.columns.pose(p.frame), affine, self.columns.field.start + p.nodes], 1)
            terms.append(
                Term(
                    (value * weight)[None],
                    np.ascontiguousarray(by_camera.T)[:, None],
                    columns,
                    np.ascontiguousarray(by_point.T)[:, None],
                    p.frame,
                    p.point,
                )
            )
        return terms

    def _linearize(self) -> Normal:
        s, columns = self.state, self.columns
        normal = self._elimination.normal_equations(self._terms(), cameras=len(self._free) > 0)
        camera, gradient, point, point_gradient = (
            normal.camera, normal.camera_gradient, normal.point, normal.point_gradient
        )  # fmt: skip
        diagonal = np.einsum("ii->i", camera)  # a view
        point[:, 2, 2] += 1.0 / self._point_sigma**2
        point_gradient[:, 2] += (s.inverse_distance - self._anchor) / self._point_sigma**2
        if self._focal_prior is not None:
            mean, information = self._focal_prior
            camera[columns.log_focal, columns.log_focal] += information
            gradient[columns.log_focal] += information @ (s.log_focal - mean)
        if self._lens_sigmas is not None:
            difference, information = self._lens_prior(s)
            diagonal[columns.lens] += information
            gradient[columns.lens] += information * difference
        if (p := self.prior) is not None:
            diagonal[columns.scales] += p.scale_sigma**-2.0
            diagonal[columns.shifts] += p.shift_sigma**-2.0
            gradient[columns.scales] += p.scale_sigma**-2.0 * (s.scale - 1.0)
            gradient[columns.shifts] += p.shift_sigma**-2.0 * s.shift
            camera[columns.field, columns.field] += p.field_information
            gradient[columns.field] += p.field_information @ s.field
        if self.control is not None:
            self.control.add(s, camera, gradient)
        return normal

    def of(self, rows: NDArray[np.bool_]) -> BundleAdjustment:
        """The tracks alone, with some of their observations, where two of a point are left."""
        o = self.observations
        rows = rows & (np.bincount(o.point, rows)[o.point] >= 2)
        points, point = np.unique(o.point[rows], return_inverse=True)
        part = BundleAdjustment(
            self.state.of(points), o.at(rows, point=point), self.options,
            sigma=self.sigma, **self._freedom,
        )  # fmt: skip
        part._anchor, part._point_sigma = self._anchor[points], self._point_sigma
        return part

    # --- solving ------------------------------------------------------------------------------------------------

    def lens_step(self) -> Array:
        """By how much a Newton step moves what is free of log focal lengths and shape; 0 of what nothing is seen."""
        information, gradient = self.condensed()
        seen = information.diagonal() > 1e-200
        step = np.zeros(len(gradient))
        step[seen] = -np.linalg.solve(information[np.ix_(seen, seen)], gradient[seen])
        return np.asarray(step[np.searchsorted(self._free, self.columns.optics.start + self.free_lens)])

    def condensed(self) -> tuple[Array, Array]:
        """Information matrix and gradient of the free camera side at the present state, the points eliminated."""
        normal = self._linearize()
        information, gradient, _ = reduced(normal, self._elimination.cross_blocks(normal), 0.0)
        return conditioned(information[np.ix_(self._free, self._free)]), gradient[self._free]

    def _step(
        self, normal: Normal, blocks: list[Block], damping: float, solve_cameras: CameraSolver
    ) -> tuple[Array, Array]:
        information, gradient, point_covariance = reduced(normal, blocks, damping)
        free = self._free
        camera = np.zeros(self.columns.size)
        camera[free] = solve_cameras(self.state, conditioned(information[np.ix_(free, free)]), gradient[free])
        pull = normal.point_gradient.copy()
        for cross, columns, span in blocks:
            pull[span] += (camera[columns] @ cross).reshape(-1, 3)
        return camera, -np.einsum("nij,nj->ni", point_covariance, pull)

    def _retract(self, camera: Array, point: Array) -> State:
        s, columns = self.state, self.columns
        pose = camera[columns.poses].reshape(-1, 6)
        turn = exponential(-pose[:, :3])
        log_focal = camera[columns.log_focal]
        by_lens = float(log_focal[s.group[s.world]])
        # A new focal length moves the points along, so that the world's camera sees them where it did: what the step
        # says of that to first order is done in full. The other focal lengths are relative to that of this camera.
        stretch = np.array([np.exp(-by_lens), np.exp(-by_lens), 1.0])
        tangent, side = tangent_basis(s.bearing), s.bearing * [1.0, 1.0, 0.0]
        turned = point[:, :2] + by_lens * np.einsum("ni,nij->nj", side, tangent)
        nearer = point[:, 2] - by_lens * s.inverse_distance * (side**2).sum(1)
        bearing = (s.bearing + np.einsum("nij,nj->ni", tangent, turned)) * stretch
        length = np.linalg.norm(bearing, axis=1)
        return State(
            rotation=turn @ s.rotation,
            translation=np.einsum("nij,nj->ni", turn, s.translation - pose[:, 3:]),
            bearing=bearing / length[:, None],
            inverse_distance=(s.inverse_distance + nearer) / length,
            log_focal=s.log_focal + log_focal,
            lens=s.lens + camera[columns.lens],
            scale=s.scale + camera[columns.scales],
            shift=s.shift + camera[columns.shifts],
            control=s.control + camera[columns.control],
            field=s.field + camera[columns.field],
            group=s.group,
            world=s.world,
        )

    def solve(self, iterations: int | None = None, solve_cameras: CameraSolver = _newton_step) -> State:
        """Minimise; the result is also `self.state`.

        Args:
            iterations: at most; those of the options by default.
            solve_cameras: see `CameraSolver`.
        """
        damping = _FIRST_DAMPING
        cost = self.cost()
        for _ in range(iterations or self.options.iterations):
            normal = self._linearize()
            blocks = self._elimination.cross_blocks(normal) if len(self._free) else []
            while damping < _LARGEST_DAMPING:
                candidate = self._retract(*self._step(normal, blocks, damping, solve_cameras))
                new_cost = self._cost(candidate)
                if new_cost < cost:
                    break
                damping *= 8.0
            else:
                break
            self.iterations += 1
            decrease = (cost - new_cost) / cost
            self.state, cost = candidate, new_cost
            damping = max(damping / 5.0, 1e-9)
            if decrease < self.options.tolerance:
                break
        return self.state

    # --- uncertainty --------------------------------------------------------------------------------------------

    def marginals(self) -> Marginals:
        """Everything that covariances are made of, at the present state; zero for variables that are held."""
        normal = self._linearize()
        blocks = self._elimination.cross_blocks(normal)
        information, _, given_camera = reduced(normal, blocks, 0.0)
        free = self._free
        camera = np.zeros((self.columns.size, self.columns.size))
        camera[np.ix_(free, free)] = np.linalg.inv(conditioned(information[np.ix_(free, free)]))
        return Marginals(camera, given_camera, blocks)

    def influences(self, columns: Index) -> Array:
        """(n, p) by how much the residuals of each point alone move some columns of the camera side.

        At the minimum they cancel; their squares tell how uncertain the columns are, whatever the noise really is.
        """
        normal = self._linearize()
        blocks = self._elimination.cross_blocks(normal)
        information, _, given_camera = reduced(normal, blocks, 0.0)
        free = self._free
        gain = np.zeros((self.columns.size, len(columns)))
        gain[free] = np.linalg.inv(conditioned(information[np.ix_(free, free)]))[:, np.searchsorted(free, columns)]
        moved = np.zeros((len(self.state.bearing), len(columns)))
        for t in normal.terms:
            by_camera = np.einsum("cdm,dm->mc", t.by_camera, t.residual)
            np.add.at(moved, t.point, np.einsum("mc,mcp->mp", by_camera, gain[t.columns]))
        step = np.einsum("nij,nj->ni", given_camera, normal.point_gradient)
        for cross, used, span in blocks:
            pull = cross.reshape(len(used), -1, 3)
            moved[span] -= np.einsum("cni,ni,cp->np", pull, step[span], gain[used], optimize=True)
        return -moved
