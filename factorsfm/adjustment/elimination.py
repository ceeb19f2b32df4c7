"""Normal equations of residuals on cameras and points, and the elimination of the points from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.track_errors import STRETCH, TrackErrors
from factorsfm.support.semidefinite import covariance_and_root

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Camera-point block of the information matrix (columns, 3 n), its columns, and its n points (ascending).
Block = tuple[Array, Index, Index]
# Rows of a frame, their columns, and the position of each entry among the columns; None: they are in order everywhere.
Group = tuple[Index, Index, Index | None]
# Flat positions of the values of columns of which each row has its own, whether no two have the same one, and these
# columns; then of the sums over each point of those that all rows share, the point's first row, and these columns.
Places = tuple[NDArray[np.intp], bool, Index, NDArray[np.intp], Index, Index]

# Points that are eliminated together make a block that is dense over all cameras that see any of them. So those that
# the same cameras see are: in pieces, which are joined where the zeros that this adds cost less than one block more,
# about as much as so many points do.
_PIECE, _LARGEST, _ONE_BLOCK = 32, 512, 40
_ROWS = 16  # of a block worked on at once: they stay in the processor's cache


@dataclass(frozen=True)
class Term:
    """Linearised residuals, the observations along the last axis (contiguous, so that numpy runs at full speed).

    Attributes:
        residual: (d, m); by_camera: (c, d, m); by_point: (3, d, m).
        columns: (m, c) camera-side variables of `by_camera`; frame, point: (m,).
        errors: correlation of the residuals, which are decorrelated then, unlike the derivatives; None: independent.
    """

    residual: Array
    by_camera: Array
    columns: Index
    by_point: Array
    frame: Index
    point: Index
    errors: TrackErrors | None = None

    @cached_property
    def decorrelated_by_point(self) -> Array:
        return self.by_point if self.errors is None else self.errors.decorrelated(self.by_point)


@dataclass(slots=True)
class Normal:
    """Normal equations before the points are eliminated."""

    camera: Array  # (c, c)
    camera_gradient: Array  # (c,)
    point: Array  # (n, 3, 3)
    point_gradient: Array  # (n, 3)
    terms: list[Term]


class Elimination:
    """Sums and blocks over residuals whose variables are the same at every linearisation.

    Args:
        columns, points: how many variables the camera side has, and how many points there are.
    """

    def __init__(self, columns: int, points: int) -> None:
        self._columns, self._points = columns, points
        self._groups: list[tuple[list[Group], Index, Index]] | None = None
        self._chunks: list[tuple[list[tuple[Index, Places]], Index, Index]] | None = None

    def normal_equations(self, terms: list[Term], *, cameras: bool = True) -> Normal:
        """Information and gradient of the cameras, if wanted, and of each point; each term is sorted by point."""
        c, n = self._columns, self._points
        camera, gradient = np.zeros((c, c)), np.zeros(c)
        point, point_gradient = np.zeros((n, 3, 3)), np.zeros((n, 3))
        for t, (groups, seen, first) in zip(terms, self._frame_groups(terms, cameras), strict=True):
            for rows, columns, local in groups:
                dense = t.by_camera.take(rows, axis=2)
                if local is not None:
                    entries, dense = dense, np.zeros((len(columns), *dense.shape[1:]))
                    np.put_along_axis(dense, np.broadcast_to(local.T[:, None], entries.shape), entries, 0)
                dense = dense.reshape(len(columns), dense.shape[1] * len(rows))
                camera[np.ix_(columns, columns)] += dense @ dense.T
                gradient[columns] += dense @ t.residual[:, rows].ravel()
            if t.errors is not None and groups:
                self._take_away_repeated(camera, t, t.errors, groups)
            by_point = t.decorrelated_by_point
            for i in range(3):
                point_gradient[seen, i] += np.add.reduceat((t.by_point[i] * t.residual).sum(0), first)
                for j in range(i, 3):
                    sums = np.add.reduceat((t.by_point[i] * by_point[j]).sum(0), first)
                    point[seen, i, j] += sums
                    if j > i:
                        point[seen, j, i] += sums
        return Normal(camera, gradient, point, point_gradient, terms)

    def _take_away_repeated(self, camera: Array, t: Term, errors: TrackErrors, groups: list[Group]) -> None:
        """Subtract from the information of the cameras what correlated residuals of a stretch count twice."""
        frames = np.array([t.frame[rows[0]] for rows, _, _ in groups])
        scale = errors.root_weight * np.sqrt(errors.shared)[errors.stretch]
        for window in np.unique(frames // STRETCH):
            mine = [groups[k] for k in np.nonzero(frames // STRETCH == window)[0]]
            occurring, _ = self._occurring(*(columns for _, columns, _ in mine))
            seen = np.unique(errors.stretch[np.concatenate([rows for rows, _, _ in mine])])
            total = np.zeros((len(occurring), len(t.residual), len(seen)))
            for rows, columns, local in mine:
                at = np.searchsorted(occurring, columns)
                at = at[:, None] if local is None else at[local.T]
                place = np.searchsorted(seen, errors.stretch[rows])
                for d in range(total.shape[1]):
                    total[at, d, place] += t.by_camera[:, d, rows] * scale[rows]
            flat = total.reshape(len(occurring), -1)
            camera[np.ix_(occurring, occurring)] -= flat @ flat.T

    def _frame_groups(self, terms: list[Term], cameras: bool) -> list[tuple[list[Group], Index, Index]]:
        """For every term: its rows by frame, if wanted; the points that occur, and the first row of each."""
        if self._groups is None:
            self._groups = []
            for t in terms:
                order = np.argsort(t.frame, kind="stable")
                groups: list[Group] = []
                for rows in np.split(order, np.nonzero(np.diff(t.frame[order]))[0] + 1) if cameras else []:
                    mine = t.columns[rows]
                    columns, (local,) = self._occurring(mine)
                    same = local.shape[1] == len(columns) and bool((local == np.arange(len(columns))).all())
                    groups.append((rows, columns, None if same else local))
                self._groups.append((groups, *np.unique(t.point, return_index=True)))
        return self._groups

    def _chunk_indices(self, terms: list[Term]) -> list[tuple[list[tuple[Index, Places]], Index, Index]]:
        """For every chunk of points: rows of each term and places in the cross blocks, the columns, the points."""
        if self._chunks is None:
            self._chunks = []
            chunks = _seen_alike(terms[0], self._points) if self._points else []
            chunk, place = np.empty((2, self._points), np.int64)  # of each point, and where it is there
            for k, points in enumerate(chunks):
                chunk[points], place[points] = k, np.arange(len(points))
            by_term = [_rows_of(chunk[t.point], len(chunks)) for t in terms]
            for k, points in enumerate(chunks):
                rows = [of_chunk[k] for of_chunk in by_term]
                columns, locals_ = self._occurring(*(t.columns[r] for t, r in zip(terms, rows, strict=True)))
                places = [
                    (r, self._places(t.columns[r], local.T[:, None] * 3 * len(points), place[t.point[r]]))
                    for t, r, local in zip(terms, rows, locals_, strict=True)
                ]
                self._chunks.append((places, columns, points))
        return self._chunks

    def _places(self, columns: Index, begin: Index, point: Index) -> Places:
        """Places in a chunk of values of the columns (m, k); `begin`: (k, 1, m) of each, `point`: (m,)."""
        position = begin + 3 * point + np.arange(3)[:, None]
        common = (columns == columns[:1]).all(0)
        _, first = np.unique(point, return_index=True)
        own, sums = np.flatnonzero(~common), np.flatnonzero(common)
        flat = position[own].ravel()
        return (
            flat,
            bool(np.bincount(flat, minlength=1).max() <= 1),
            own,
            position[sums][:, :, first].ravel(),
            first,
            sums,
        )

    def _occurring(self, *columns: Index) -> tuple[Index, list[Index]]:
        """The columns that occur (ascending), and where among them each of the given ones is."""
        occurs = np.zeros(self._columns, bool)
        for some in columns:
            occurs[some] = True
        place = np.cumsum(occurs) - 1
        return np.flatnonzero(occurs), [place[some] for some in columns]

    def cross_blocks(self, normal: Normal) -> list[Block]:
        """Camera-point blocks of the information matrix, dense over the columns of each chunk."""
        blocks = []
        for places, columns, points in self._chunk_indices(normal.terms):
            n = len(points)
            cross = np.zeros(len(columns) * 3 * n)
            for t, (rows, (position, single, own, of_sums, first, common)) in zip(normal.terms, places, strict=True):
                by_camera, by_point = t.by_camera.take(rows, axis=2), t.decorrelated_by_point.take(rows, axis=2)
                by_own = by_camera[own] if len(common) else by_camera
                values = np.einsum("cdm,pdm->cpm", by_own, by_point).ravel()
                if single and t is normal.terms[0]:
                    cross[position] = values
                elif single:
                    cross[position] += values
                else:
                    cross += np.bincount(position, values, len(cross))
                if len(common) and len(first):
                    values = np.einsum("cdm,pdm->cpm", by_camera[common], by_point)
                    cross[of_sums] += np.add.reduceat(values, first, axis=2).ravel()
            blocks.append((cross.reshape(len(columns), 3 * n), columns, points))
        return blocks


def _seen_alike(term: Term, count: int) -> list[Index]:
    """All points (ascending in each) in chunks that about the same frames see."""
    frame, first = term.frame, np.searchsorted(term.point, np.arange(count))
    begins, ends = frame[first], frame[np.append(first[1:], len(frame)) - 1]
    order = np.lexsort((ends, begins, -np.log2(ends - begins + 1.0).astype(int)))
    pieces = np.split(order, range(_PIECE, count, _PIECE))
    piece = np.empty(count, np.int64)
    piece[order] = np.arange(count) // _PIECE
    seen = np.zeros((len(pieces), int(frame.max(initial=0)) + 1), bool)
    seen[piece[term.point], frame] = True

    def cost(by: NDArray[np.bool_], points: int) -> int:
        return int(by.sum()) ** 2 * (points + _ONE_BLOCK)

    chunks: list[Index] = []
    members, by = pieces[0], seen[0]
    for more, its in zip(pieces[1:], seen[1:], strict=True):
        size = len(members) + len(more)
        if size <= _LARGEST and cost(by | its, size) <= cost(by, len(members)) + cost(its, len(more)):
            members, by = np.concatenate([members, more]), by | its
        else:
            chunks.append(np.sort(members))
            members, by = more, its
    return [*chunks, np.sort(members)]


def _rows_of(label: Index, count: int) -> list[Index]:
    """Rows (ascending) of each of so many labels."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))


def reduced(normal: Normal, blocks: list[Block], damping: float) -> tuple[Array, Array, Array]:
    """Information and gradient of the camera side with the points eliminated, and the points' covariance."""
    point = normal.point.copy()
    diagonal = np.einsum("nii->ni", point)
    diagonal += damping * diagonal + 1e-12
    point_covariance, root = covariance_and_root(point)
    information = normal.camera.copy()
    information[np.diag_indices_from(information)] *= 1.0 + damping
    gradient = normal.camera_gradient.copy()
    for cross, columns, points in blocks:
        half = _rooted(cross, root[points])
        information[np.ix_(columns, columns)] -= half @ half.T
        step = np.einsum("nij,nj->ni", point_covariance[points], normal.point_gradient[points])
        gradient[columns] -= cross @ step.ravel()
    return information, gradient, point_covariance


def _rooted(cross: Array, root: Array) -> Array:
    """(c, 3 n) cross blocks, the columns of each point times its lower triangular (3, 3) root, in another order."""
    n = len(root)
    half = np.empty((len(cross), 3, n))
    (a, _, _), (b, d, _), (c, e, f) = root.transpose(1, 2, 0)
    for begin in range(0, len(cross), _ROWS):
        x, y, z = np.ascontiguousarray(cross[begin : begin + _ROWS].reshape(-1, n, 3).transpose(2, 0, 1))
        part = half[begin : begin + _ROWS]
        part[:, 0] = x * a + y * b + z * c
        part[:, 1] = y * d + z * e
        part[:, 2] = z * f
    return half.reshape(len(cross), 3 * n)
