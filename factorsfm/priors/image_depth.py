"""What the depth prior says at the keypoints of one image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ImageDepth:
    """Depth prior at the keypoints of one image, NaN where it is invalid.

    Attributes:
        inverse_depth: (n,) in units of the map's median; `unit` times this is the map's own unit.
        reliability: (n,) in [0, 1], low on depth edges.
        unit: factor to the unit of the prior's map.
        free_shift: whether the inverse depth is known up to a shift only (relative networks).
    """

    inverse_depth: Array
    reliability: Array
    unit: float
    free_shift: bool = True

    @property
    def valid(self) -> NDArray[np.bool_]:
        return np.isfinite(self.inverse_depth) & (self.reliability > 0.5) & (self.inverse_depth > 0.02)

    def padded(self, count: int) -> ImageDepth:
        """With nothing known at further keypoints."""
        none = np.zeros(count)
        return replace(self, inverse_depth=np.r_[self.inverse_depth, none], reliability=np.r_[self.reliability, none])

    def of(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> ImageDepth:
        """At some of the n keypoints."""
        return replace(self, inverse_depth=self.inverse_depth[kept], reliability=self.reliability[kept])
