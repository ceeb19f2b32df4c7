"""Newton steps of a solution without some of its observations, from one linearisation of all of them.

Before the points are eliminated, the information of the observations adds up. Without a part of them it changes where
that part is: only the points that the part sees are eliminated again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.elimination import Block, Elimination, Normal, Term, reduced

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDING = 1e-12  # of the information of a variable, left where all of it is taken away


class LeftOut:
    """Information and gradient of the camera side without some observations, the points eliminated.

    Args:
        normal: of the tracks, which have independent errors, and of the terms that stay; blocks: its cross blocks.
    """

    def __init__(self, normal: Normal, blocks: list[Block]) -> None:
        (self._term,) = normal.terms
        assert self._term.errors is None
        self._normal = normal
        self._information, self._gradient, _ = reduced(normal, blocks, 0.0)
        size, points = len(normal.camera), len(normal.point)
        self._cross = np.zeros((size, points, 3))
        for cross, columns, seen in blocks:
            self._cross[np.ix_(columns, seen)] = cross.reshape(len(columns), -1, 3)

    def without(self, rows: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Without these observations, nor the last one of a point of which one is left: (c, c), 0 for what nothing
        sees any more, and (c,)."""
        rows = rows | ~self._enough(~rows)
        touched, term = self._part(rows)
        size, gone = len(self._normal.camera), ~np.isin(touched, self._term.point[~rows])
        elimination = Elimination(size, len(touched))
        part = elimination.normal_equations([term])
        nothing, zero = np.zeros((size, size)), np.zeros(size)
        before = Normal(nothing, zero, self._normal.point[touched], self._normal.point_gradient[touched], [])
        point, pull, cross = (
            before.point - part.point,
            before.point_gradient - part.point_gradient,
            self._cross[:, touched],
        )
        known = self._eliminated(before, cross)
        for block, columns, seen in elimination.cross_blocks(part):
            cross[np.ix_(columns, seen)] -= block.reshape(len(columns), -1, 3)
        point[gone], pull[gone], cross[:, gone] = np.eye(3), 0.0, 0.0
        left = self._eliminated(Normal(nothing, zero, point, pull, []), cross)
        information = self._information - part.camera + left[0] - known[0]
        camera = self._normal.camera.diagonal()
        unseen = camera - part.camera.diagonal() <= _ROUNDING * camera
        information[unseen] = information[:, unseen] = 0.0
        return information, self._gradient - part.camera_gradient + left[1] - known[1]

    def _enough(self, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(m,) which of these observations are of points of which they are two or more."""
        point = self._term.point
        return np.asarray(rows & (np.bincount(point, rows)[point] >= 2))

    def _part(self, rows: NDArray[np.bool_]) -> tuple[Index, Term]:
        """The points that some observations are of, and their linearisation on these points alone."""
        t = self._term
        touched, point = np.unique(t.point[rows], return_inverse=True)
        return touched, Term(
            t.residual[:, rows], t.by_camera[:, :, rows], t.columns[rows], t.by_point[:, :, rows], t.frame[rows], point
        )

    def _eliminated(self, normal: Normal, cross: Array) -> tuple[Array, Array]:
        """What the elimination of some points adds to information and gradient."""
        columns = np.flatnonzero(cross.any(axis=(1, 2)))
        block = cross[columns].reshape(len(columns), 3 * cross.shape[1]), columns, np.arange(len(normal.point))
        return reduced(normal, [block], 0.0)[:2]
