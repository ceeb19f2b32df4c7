"""Errors that neighbouring tracks share: what they add to the covariances of a solution.

The normal equations take tracks as wrong one by one, at most for a stretch of frames. Neighbours are wrong together:
their patches overlap, compression moves whole blocks of the image, something sways. Two parts of that are measured, a
third one is known.

- **Neighbourhoods.** The tracks of a neighbourhood of the scene may repeat each other in any way and for the whole
  shot; neighbourhoods are independent. What the residuals of one, all together, do to the solution is one standard
  deviation of its errors (covariance of clustered errors: Liang and Zeger, Biometrika 1986; the share of its errors
  that a neighbourhood hides by its own say is given back: Bell and McCaffrey, Survey Methodology 2002).
- **Single frames.** An error that is smooth over a frame moves its camera and leaves no residuals, so that no sum of
  residuals shows it. It is inferred from what residuals do show, the covariance of neighbours in the same frame,
  which falls with their distance d as ``s^2 / (1 + d / reach)``. Each camera, the first too, is wrong by the part of
  such a field that looks like a motion of the camera.
- **Changes of view.** A patch looks different from elsewhere, and is found beside its place by a little that grows with
  the way of the camera. Where that is smooth over the image, a curved path and other distances explain it as well, and
  all tracks of the shot agree on them: nothing shows it. It is taken to be as large as on shots whose truth is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.elimination import Term
from factorsfm.adjustment.marginals import Marginals, in_scene_unit, unit_motion
from factorsfm.adjustment.prior_weight import direction_angles
from factorsfm.adjustment.state import State
from factorsfm.support.rotations import cross_matrices

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Neighbourhoods of the scene, across and down: fewer know a variance badly, more cut in pieces what errs as a whole.
# From 24 to 84 of them, the median normalised error of polished cameras on rendered shots goes from 1.9 to 2.1.
_NEIGHBOURHOODS = (6, 4)
_TERMS = 2  # of the series
_CELLS = (24, 14)  # of a frame, across and down, on which smooth errors are constant
# Of the width of the image: a patch. On rendered, compressed shots of 960 pixels the covariance of the true errors of
# neighbours, mean of four shots, is 590, 450, 430, 330, 340, 290, 250 and 300 times this law at 22, 45, 80, 125, 185,
# 270, 385 and 525 pixels (in thousandths of a pixel, squared). An exponential has no such tail.
_REACH = 1.0 / 48.0
_FARTHEST = 0.065  # of the width: adjacent cells; cameras absorb much of what tracks farther apart share
# Pixels by which a track is beside its place at the border of the image and at the end of the path, by each term of a
# field that is quadratic in the place. Root mean squares on eight rendered, compressed shots and five rooms: 0.01 to
# 0.07 of the linear terms, 0.02 to 0.08 of the quadratic ones; some of it is in the neighbourhoods, too: with 0.04 the
# errors of polished cameras are too small for their covariances. A constant field is a turn of each camera, as above.
_BY_VIEW_PX = 0.025


@dataclass(frozen=True, slots=True)
class SharedErrors:
    """By how much errors that neighbours share displace a solution.

    Attributes:
        camera: (c, q) columns of the camera side, see `Columns`, and inverse_distance: (n, q) of the points, each by
            one standard deviation of each of q independent errors, of neighbourhoods and by the change of view.
        frame: (k, 6, 6) covariance of each pose by the smooth error of its frame alone.
    """

    camera: Array
    inverse_distance: Array
    frame: Array

    def in_world(self, held: NDArray[np.bool_]) -> Array:
        """(c, c) covariance of the camera side where something else than a camera is the origin; `held`: (k,)."""
        covariance = self.camera @ self.camera.T
        _add_blocks(covariance, np.where(held[:, None, None], 0.0, self.frame))
        return covariance

    def in_scene_unit(self, state: State, control: Array | None = None) -> tuple[Array, Array]:
        """As `marginals.in_scene_unit`: (c, c) covariance of the camera side, (n,) variance of the inverse distances.

        The error of the first frame moves everything else.
        """
        displaced = [self.camera], [self.inverse_distance]
        if state.world >= 0:
            for found, more in zip(displaced, self._by_world(state), strict=True):
                found.append(more)
        camera, inverse = (np.concatenate(found, 1) for found in displaced)
        grown = inverse.sum(0) / state.inverse_distance.sum()
        camera = camera - np.outer(unit_motion(state, control), grown)
        inverse = inverse - np.outer(state.inverse_distance, grown)
        covariance = camera @ camera.T
        frames = np.arange(len(self.frame)) != state.world
        _add_blocks(covariance, self.frame * frames[:, None, None])
        return covariance, (inverse**2).sum(1)

    def _by_world(self, state: State) -> tuple[Array, Array]:
        """Six more columns of the camera side and of the inverse distances, by the error of the world's frame."""
        values, vectors = np.linalg.eigh(self.frame[state.world])
        error = vectors * np.sqrt(np.maximum(values, 0.0))
        turn = state.rotation
        carried = np.zeros((len(turn), 6, 6))
        carried[:, :3, :3] = carried[:, 3:, 3:] = turn
        carried[:, 3:, :3] = cross_matrices(state.translation) @ turn
        carried[state.world] = 0.0
        camera = np.zeros((len(self.camera), 6))
        camera[Columns.of(state).poses] = -(carried @ error).reshape(-1, 6)
        nearer = (state.bearing @ error[3:]) * (state.inverse_distance**2)[:, None]
        return camera, nearer


def shared_errors(adjustment: BundleAdjustment, marginals: Marginals) -> SharedErrors:
    """Measured on the residuals of a converged adjustment; `marginals`: its own."""
    term = adjustment.track_residuals()
    parts = [_by_neighbourhood(adjustment, marginals, term)]
    if adjustment.free.translation:
        parts.append(_by_view(adjustment, marginals, term))
    camera, inverse = (np.concatenate(displaced, 1) for displaced in zip(*parts, strict=True))
    return SharedErrors(camera, inverse, _by_frame(adjustment, term))


def in_scene_unit_with(
    shared: SharedErrors, marginals: Marginals, state: State, control: Array | None = None
) -> tuple[Array, Array]:
    """(c, c) covariance of the camera side as `marginals.in_scene_unit`, and (n,) standard deviations of the inverse
    distances, by the errors of single tracks and by those that they share."""
    covariance = in_scene_unit(marginals, state, control)
    std = marginals.inverse_distance_std(covariance)
    more, variance = shared.in_scene_unit(state, control)
    return covariance + more, np.hypot(std, np.sqrt(variance))


def _add_blocks(covariance: Array, blocks: Array) -> None:
    rows = np.arange(6 * len(blocks)).reshape(-1, 6)
    covariance[rows[:, :, None], rows[:, None]] += blocks


# --- neighbourhoods ---------------------------------------------------------------------------------------------


def _by_neighbourhood(adjustment: BundleAdjustment, marginals: Marginals, term: Term) -> tuple[Array, Array]:
    """Camera side and inverse distances, as `SharedErrors` has them."""
    parts = _Neighbourhoods(term, marginals, _neighbourhoods(adjustment.state.bearing))
    gradient, step = parts.gradient(term.residual)
    moved = marginals.camera @ gradient
    # Without the neighbourhood's own information, which lets the solution follow its errors; a series that is cut off
    # where one neighbourhood decides alone.
    first = moved
    for _ in range(_TERMS):
        moved = first + marginals.camera @ parts.gradient(parts.decorrelated(moved))[0]
    return np.asarray(moved), _nearer(marginals, parts.member * step[:, 2:], moved)


def _nearer(marginals: Marginals, alone: Array, moved: Array) -> Array:
    """(n, q) inverse distances that change by `alone` (n, q) on their own while the camera side moves, (c, q)."""
    inverse = np.array(alone)
    for cross, columns, points in marginals.blocks:
        gain = np.einsum("cni,ni->nc", cross.reshape(len(columns), -1, 3), marginals.point[points, 2])
        inverse[points] -= gain @ moved[columns]
    return inverse


class _Neighbourhoods:
    """What the residuals of each neighbourhood pull at; `label`: (n,) to which each point belongs."""

    def __init__(self, term: Term, marginals: Marginals, label: Index) -> None:
        self._term, self._marginals = term, marginals
        self._row = label[term.point]
        self.member = (label[:, None] == np.arange(label.max() + 1)).astype(np.float64)

    def gradient(self, residual: Array) -> tuple[Array, Array]:
        """(c, q) of the camera side by decorrelated residuals (2, m) of each neighbourhood, points eliminated, and
        (n, 3) the step of the points."""
        t, (points, count), size = self._term, self.member.shape, len(self._marginals.camera)
        place = (t.columns.T * count + self._row).ravel()
        by_camera = np.einsum("cdm,dm->cm", t.by_camera, residual).ravel()
        sums = np.asarray(np.bincount(place, by_camera, size * count), np.float64).reshape(size, count)
        by_point = np.einsum("idm,dm->im", t.by_point, residual)
        pull = np.stack([np.bincount(t.point, row, points) for row in by_point], 1)
        step = np.einsum("nij,nj->ni", self._marginals.point, pull)
        for cross, columns, seen in self._marginals.blocks:
            through = np.einsum("cni,ni->cn", cross.reshape(len(columns), -1, 3), step[seen])
            sums[columns] -= through @ self.member[seen]
        return sums, step

    def decorrelated(self, moved: Array) -> Array:
        """(2, m) residuals that each neighbourhood would have from its own displacement (c, q) of the cameras."""
        t = self._term
        seen = np.einsum("cdm,mc->dm", t.by_camera, moved[t.columns, self._row[:, None]])
        return seen if t.errors is None else t.errors.decorrelated(seen)


def _neighbourhoods(bearing: Array) -> Index:
    """(n,) neighbourhood of each point: strips of the scene with as many points each, in pieces with as many each."""
    angles, (across, down), n = direction_angles(bearing), _NEIGHBOURHOODS, len(bearing)
    label = np.empty(n, np.int64)
    for strip, members in enumerate(np.array_split(np.argsort(angles[:, 0], kind="stable"), across)):
        order = members[np.argsort(angles[members, 1], kind="stable")]
        label[order] = strip * down + np.arange(len(order)) * down // max(len(order), 1)
    return np.unique(label, return_inverse=True)[1].astype(np.int64)


# --- changes of view --------------------------------------------------------------------------------------------


def _by_view(adjustment: BundleAdjustment, marginals: Marginals, term: Term) -> tuple[Array, Array]:
    """Camera side and inverse distances, as `SharedErrors` has them."""
    o = adjustment.observations
    x, y = (o.pixels / np.maximum(np.abs(o.pixels).max(0), 1e-9)).T
    fields = _BY_VIEW_PX / adjustment.observation_sigmas()[0] * np.stack([x, y, x * x, x * y, y * y])
    ways = _ways(adjustment.state)[:, o.frame]
    pull, step = _pulled((ways[:, None] * fields).reshape(-1, len(x)), marginals, term)
    moved = marginals.camera @ pull
    return np.asarray(moved), _nearer(marginals, step, moved)


def _pulled(error: Array, marginals: Marginals, term: Term) -> tuple[Array, Array]:
    """(c, 2 q) gradients of the camera side by q errors (q, m) of the observations along the rows of the image, and as
    many along its columns, in their standard deviations and with the points eliminated, and (n, 2 q) by which the
    inverse distances change on their own."""
    error = error if term.errors is None else term.errors.decorrelated(error)
    pull = np.zeros((len(marginals.camera), 2, len(error)))
    order = np.argsort(term.frame, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(term.frame[order])) + 1):
        by_camera = term.by_camera[:, :, rows].reshape(-1, len(rows))
        pull[term.columns[rows[0]]] += (by_camera @ error[:, rows].T).reshape(-1, 2, len(error))
    first = np.unique(term.point, return_index=True)[1]
    by_point = [np.add.reduceat(row[:, None] * error, first, axis=2) for row in term.by_point]
    step = np.einsum("nij,jdqn->dqni", marginals.point, np.stack(by_point)).reshape(2 * len(error), -1, 3)
    reduced = pull.reshape(len(pull), -1)
    for cross, columns, points in marginals.blocks:
        reduced[columns] -= cross @ step[:, points].reshape(len(step), -1).T
    return reduced, np.asarray(step[:, :, 2].T)


def _ways(state: State) -> Array:
    """(d, k) how far each camera is from the first one along d <= 3 main directions of the path, as a share of the
    longest way."""
    centers = -np.einsum("kji,kj->ki", state.rotation, state.translation)
    way = centers - centers[0]
    way = way / max(float(np.linalg.norm(way, axis=1).max()), 1e-12)
    return np.asarray(np.linalg.svd(way, full_matrices=False)[2] @ way.T)


# --- single frames ----------------------------------------------------------------------------------------------


def _by_frame(adjustment: BundleAdjustment, term: Term) -> Array:
    """(k, 6, 6) covariance of each pose by the smooth error of its frame."""
    frames, found = len(adjustment.state.rotation), np.zeros((len(adjustment.state.rotation), 6, 6))
    modes = 6 if adjustment.free.translation else 3
    cells, kernel, near = _grid(adjustment.observations.pixels)
    key = term.frame * len(kernel) + cells
    root = adjustment.sigma / adjustment.observation_sigmas()[0]

    def gathered(values: Array) -> Array:
        sums = np.bincount(key, values * root, frames * len(kernel))
        return np.asarray(sums, np.float64).reshape(frames, -1)

    weight = gathered(root)
    residual = np.stack([gathered(row * root) for row in adjustment.reprojection_vectors().T], 1)
    derivative = term.by_camera[:modes] * adjustment.sigma  # pixels, weighted
    by_pose = np.array([[gathered(row) for row in mode] for mode in derivative]).transpose(2, 0, 1, 3)
    normal = np.zeros((frames, modes, modes))
    for i in range(modes):
        for j in range(modes):
            normal[:, i, j] = np.bincount(term.frame, (derivative[i] * derivative[j]).sum(0), frames)
    gain = _inverse(normal)
    absorbed = gain @ np.einsum("kpdc,kqdc->kpq", by_pose @ kernel, by_pose) @ gain
    shown = _shown_by_neighbours(weight, by_pose, gain, kernel, near)
    power = float(np.einsum("kdc,kdc->", residual @ near, residual))
    found[:, :modes, :modes] = max(0.0, power / shown if shown > 0.0 else 0.0) * absorbed
    return found


def _grid(pixels: Array) -> tuple[Index, Array, Array]:
    """(m,) cell of each observation; (g, g) covariance of a smooth error of unit variance between cells; (g, g) the
    same, where it is not between cells that are the same or far apart."""
    across, down = _CELLS
    low, size = pixels.min(0), np.maximum(np.ptp(pixels, axis=0), 1e-9)
    cell = (0.999 * (pixels - low) / size * _CELLS).astype(np.int64)
    y, x = np.divmod(np.arange(across * down), across)
    place = np.stack([x / across, y / down * size[1] / size[0]], 1)
    distance = np.linalg.norm(place[:, None] - place, axis=2)
    inside = 0.52 / across  # mean distance of two places in a square cell
    kernel = 1.0 / (1.0 + np.where(distance > 0.0, distance, inside) / _REACH)
    return cell[:, 1] * across + cell[:, 0], kernel, kernel * ((distance > 0.0) & (distance < _FARTHEST))


def _shown_by_neighbours(weight: Array, by_pose: Array, gain: Array, kernel: Array, near: Array) -> float:
    """What products of residuals of neighbours add up to, of a smooth error of unit variance less what cameras absorb.

    Args:
        weight: (k, g) sums over the cells of each frame; by_pose: (k, p, 2, g) sums of derivatives;
        gain: (k, p, p) inverse information of the poses; kernel, near: as `_grid` gives them.
    """
    whole = 2.0 * np.einsum("kc,kc->", weight @ (kernel * near), weight)
    spread, compared = by_pose @ kernel, by_pose @ near
    mixed = np.einsum("kpdc,kqdc->kpq", compared, weight[:, None, None] * spread)
    absorbed = gain @ np.einsum("kpdc,kqdc->kpq", spread, by_pose)
    twice = absorbed @ gain @ np.einsum("kpdc,kqdc->kpq", compared, by_pose)
    return float(whole - 2.0 * np.einsum("kpq,kpq->", gain, mixed) + np.einsum("kpp->", twice))


def _inverse(normal: Array) -> Array:
    """(k, p, p) inverse of information matrices, 0 along what a frame does not determine."""
    diagonal = np.einsum("kpp->kp", normal)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    outer = scale[:, :, None] * scale[:, None]
    return np.asarray(np.linalg.pinv(normal / outer, rcond=1e-9, hermitian=True) / outer)
