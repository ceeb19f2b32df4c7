"""Bundle adjustment: Levenberg-Marquardt over all variables of a `State`, the points eliminated first.

In these shots every camera sees every point, so that the reduced system of the cameras is dense. General solvers are
about as fast, given the same ordering: GTSAM takes 0.7 to 2 times as long, Ceres 0.3 to 1.2 times. This solver is here
for its models: errors that persist along a track, an unknown lens and shutter, and the smooth error of a depth prior.
Points are unit bearings with an inverse distance, in which small motion is almost linear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.depth_term import AffinePrior, DepthTerm
from factorsfm.adjustment.elimination import Block, Elimination, Normal, Term, reduced
from factorsfm.adjustment.left_out import LeftOut
from factorsfm.adjustment.marginals import Marginals, tangent_basis
from factorsfm.adjustment.noise import block_inflation, shared_sigma
from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.adjustment.problem import NOTHING, POSES, CameraTerm, ErrorModel, Free, Known
from factorsfm.adjustment.residuals import cauchy
from factorsfm.adjustment.state import LENS_SIZE, State
from factorsfm.adjustment.track_term import TrackTerm
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import exponential
from factorsfm.support.semidefinite import conditioned, covariance_of, solution

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FIRST_DAMPING = 1e-4
_LARGEST_DAMPING = 1e6


class BundleAdjustment:
    """Levenberg-Marquardt over poses, points, lens, prior affines and the prior's smooth error field.

    Args:
        state: where it starts; a weak prior keeps the inverse distances of the points near those of this state.
        observations: sorted by point; every point has at least one.
        options: kernel, weak prior of the points, iterations.
        prior: depth-prior values, or None.

    Attributes:
        state: the present solution.
        columns: of the camera side.
        held: (k,) frames whose poses are constant.
        free_optics: rows of what is estimated among the log focal lengths and `State.lens`.
        iterations: of all calls of `solve`.
    """

    def __init__(
        self,
        state: State,
        observations: Observations,
        options: PolishOptions,
        errors: ErrorModel,
        *,
        prior: PriorObservations | None = None,
        free: Free = POSES,
        known: Known = NOTHING,
    ) -> None:
        if (np.diff(observations.point) < 0).any():
            raise ValueError("observations must be sorted by point")
        self.state, self.observations, self.options = state, observations, options
        self.errors, self.prior, self.free, self.known = errors, prior, free, known
        self.iterations = 0
        self.columns = Columns.of(state)
        frames = len(state.rotation)
        held = np.arange(frames) == state.world if free.held is None else free.held
        self.held = held | (np.bincount(observations.frame, minlength=frames) == 0)  # no observation determines them
        estimated = self._estimated()
        self._free = np.nonzero(estimated & free.cameras)[0]
        self.free_optics = np.nonzero(estimated[self.columns.optics])[0]
        self._tracks = TrackTerm(
            state, observations, errors, options.kernel,
            focal=free.focal, lens=np.zeros(LENS_SIZE, bool) if known.lens is None else known.lens.free,
        )  # fmt: skip
        self._depth = DepthTerm(prior, options.kernel) if prior is not None else None
        self._camera_terms: list[CameraTerm] = known.terms + ([AffinePrior(prior)] if prior is not None else [])
        self._anchor = state.inverse_distance.copy()
        typical = float(np.median(self._anchor)) if len(self._anchor) else 0.0
        self._point_sigma = options.point_sigma * max(typical, 1e-9)
        self._elimination = Elimination(self.columns.size, len(state.bearing))

    def _estimated(self) -> NDArray[np.bool_]:
        """(c,) columns that are estimated unless the points alone are."""
        columns, free, known = self.columns, self.free, self.known
        estimated = np.ones(columns.size, bool)
        estimated[columns.poses] = np.repeat(~self.held, 6)
        if not free.translation:
            estimated[columns.poses].reshape(-1, 6)[:, 3:] = False
        estimated[columns.log_focal] = free.focal
        estimated[columns.lens] = known.lens is not None and known.lens.free
        estimated[columns.control] = known.control is not None and known.control.free
        return estimated

    # --- residuals ----------------------------------------------------------------------------------------------

    @property
    def sigma(self) -> float:
        """Standard deviation of a coordinate of an observation (pixels)."""
        return self.errors.sigma

    def reprojection_errors(self) -> Array:
        """(m,) distance between observed and predicted position (pixels)."""
        return np.asarray(np.linalg.norm(self.reprojection_vectors(), axis=1))

    def reprojection_vectors(self) -> Array:
        """(m, 2) predicted minus observed position (pixels)."""
        return self._tracks.residual(self.state) * self.sigma

    def cost(self) -> float:
        """Robust cost at the present state."""
        return self._cost(self.state)

    def observation_costs(self) -> Array:
        """(m,) robust cost of each observation; noise alone costs about one."""
        return self._tracks.costs(self.state)

    def error_inflation(self) -> float:
        """Factor on the variance because the errors of neighbouring tracks are correlated, see `block_inflation`."""
        return block_inflation(*self._errors_in_place())

    def shared_error(self) -> float:
        """Part of an error that neighbouring tracks have in common (standard deviation of a coordinate, pixels)."""
        return shared_sigma(*self._errors_in_place())

    def _errors_in_place(self) -> tuple[Array, Index, Array]:
        place = self.state.normalized(self.observations)
        return self.reprojection_vectors(), self.observations.frame, place

    def observation_sigmas(self) -> tuple[Array, Array]:
        """(m,) standard deviations that the observations have at their present weights, and (n,) of the error that
        each track keeps over a stretch (pixels)."""
        errors = self.errors.tracks
        if errors is None:
            weight = cauchy(self._tracks.residual(self.state), self.options.kernel)[1]
            return self.sigma / np.sqrt(weight), np.zeros(len(self.state.bearing))
        return self.sigma / errors.root_weight, self.sigma / errors.sigma * errors.persistent

    def prior_residuals(self) -> tuple[Array, Array]:
        """(m,) residuals of the prior, and their standard deviations at their present weights (unit of its inverse
        depth)."""
        assert self.prior is not None
        residual = DepthTerm(self.prior, self.options.kernel).residual(self.state)
        weight = cauchy(residual[:, None], self.options.kernel)[1]
        return residual * self.prior.sigma, self.prior.sigma / np.sqrt(weight)

    def _cost(self, state: State) -> float:
        cost = self._tracks.cost(state)
        cost += 0.5 * float((((state.inverse_distance - self._anchor) / self._point_sigma) ** 2).sum())
        cost += 0.0 if self._depth is None else self._depth.cost(state)
        return cost + sum(term.cost(state) for term in self._camera_terms)

    def _linearize(self) -> Normal:
        s, cameras = self.state, len(self._free) > 0
        terms = [term.linearized(s, cameras=cameras) for term in (self._tracks, self._depth) if term is not None]
        normal = self._elimination.normal_equations(terms, cameras=cameras)
        normal.point[:, 2, 2] += 1.0 / self._point_sigma**2
        normal.point_gradient[:, 2] += (s.inverse_distance - self._anchor) / self._point_sigma**2
        for term in self._camera_terms:
            term.add(s, normal.camera, normal.camera_gradient)
        return normal

    # --- solving ------------------------------------------------------------------------------------------------

    def lens_step(self) -> Array:
        """By how much a Newton step moves what is free of log focal lengths and shape; 0 of what nothing is seen."""
        normal = self._linearize()
        return self._lens_step(*reduced(normal, self._elimination.cross_blocks(normal), 0.0)[:2])

    def lens_steps_without(self, part: Index) -> Array:
        """(parts, c) as `lens_step`, of the tracks without each part of their observations; `part`: (m,) of each."""
        normal = self._linearize()
        rest = LeftOut(normal, self._elimination.cross_blocks(normal))
        return np.array([self._lens_step(*rest.without(part == left_out)) for left_out in np.unique(part)])

    def _lens_step(self, information: Array, gradient: Array) -> Array:
        free = self._free[information.diagonal()[self._free] > 1e-100]
        step = np.zeros(self.columns.size)
        step[free] = -solution(conditioned(information[np.ix_(free, free)]), gradient[free])
        return step[self.columns.optics][self.free_optics]

    def condensed(self) -> tuple[Array, Array]:
        """Information matrix and gradient of the free camera side at the present state, the points eliminated."""
        normal = self._linearize()
        information, gradient, _ = reduced(normal, self._elimination.cross_blocks(normal), 0.0)
        return conditioned(information[np.ix_(self._free, self._free)]), gradient[self._free]

    def _step(self, normal: Normal, blocks: list[Block], damping: float) -> tuple[Array, Array]:
        information, gradient, point_covariance = reduced(normal, blocks, damping)
        free = self._free
        camera = np.zeros(self.columns.size)
        camera[free] = -solution(conditioned(information[np.ix_(free, free)]), gradient[free])
        pull = normal.point_gradient.copy()
        for cross, columns, points in blocks:
            pull[points] += (camera[columns] @ cross).reshape(-1, 3)
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

    def solve(self, iterations: int | None = None) -> State:
        """Minimise; the result is also `self.state`.

        Args:
            iterations: at most; those of the options by default.
        """
        damping = _FIRST_DAMPING
        cost = self.cost()
        for _ in range(iterations or self.options.iterations):
            normal = self._linearize()
            blocks = self._elimination.cross_blocks(normal) if len(self._free) else []
            while damping < _LARGEST_DAMPING:
                candidate = self._retract(*self._step(normal, blocks, damping))
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
        camera[np.ix_(free, free)] = covariance_of(conditioned(information[np.ix_(free, free)]))
        return Marginals(camera, given_camera, blocks)

    def track_residuals(self) -> Term:
        """The residuals of the tracks, linearised at the present state."""
        return self._tracks.linearized(self.state)

    def influences(self, marginals: Marginals, columns: Index) -> Array:
        """(n, p) by how much the residuals of each point alone move some columns of the camera side.

        At the minimum they cancel; their squares tell how uncertain the columns are, whatever the noise really is.

        Args:
            marginals: of the present state.
        """
        normal, gain = self._linearize(), marginals.camera[:, columns]
        moved = np.zeros((len(self.state.bearing), len(columns)))
        for t in normal.terms:
            by_camera = np.einsum("cdm,dm->mc", t.by_camera, t.residual)
            np.add.at(moved, t.point, np.einsum("mc,mcp->mp", by_camera, gain[t.columns]))
        step = np.einsum("nij,nj->ni", marginals.point, normal.point_gradient)
        for cross, used, points in marginals.blocks:
            pull = cross.reshape(len(used), -1, 3)
            moved[points] -= np.einsum("cni,ni,cp->np", pull, step[points], gain[used], optimize=True)
        return -moved
