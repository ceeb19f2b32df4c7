"""The columns of an adjustment's linear system, after the points are eliminated: which variable each belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.state import LENS_SIZE, State

Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns of the camera side: one for every variable of a `State` but the points, estimated or not.

    Attributes:
        poses: six a frame, a rotation vector before a translation (GTSAM's convention).
        log_focal: one a focal length.
        lens: as `State.lens`.
        affines: scale and shift of each image with a prior.
        field: one a node of the prior's error field.
        control: as `State.control`.
    """

    poses: slice
    log_focal: slice
    lens: slice
    affines: slice
    field: slice
    control: slice

    @classmethod
    def of(cls, state: State) -> Columns:
        """Those of the variables of a state."""
        sizes = (
            6 * len(state.rotation), len(state.log_focal), LENS_SIZE,
            2 * len(state.scale), len(state.field), len(state.control),
        )  # fmt: skip
        return cls(*(slice(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True)))

    @property
    def size(self) -> int:
        """How many there are."""
        return int(self.control.stop)

    @property
    def optics(self) -> slice:
        """Focal lengths and shape of the lens."""
        return slice(self.log_focal.start, self.lens.stop)

    @property
    def scales(self) -> slice:
        """Of the affines."""
        return slice(self.affines.start, self.affines.stop, 2)

    @property
    def shifts(self) -> slice:
        """Of the affines."""
        return slice(self.affines.start + 1, self.affines.stop, 2)

    def pose(self, frame: int | Index) -> Index:
        """(..., 6) columns of the poses of some frames."""
        return np.asarray(6 * np.asarray(frame)[..., None] + np.arange(6))
