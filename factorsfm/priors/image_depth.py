"""The depth prior at the keypoints of one image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LEAST_RELIABILITY = 0.5
_LEAST_INVERSE_DEPTH = 0.02  # in units of the median: 50 times as far away


@dataclass(frozen=True, slots=True)
class ImageDepth:
    """The depth prior at the n keypoints of one image.

    Attributes:
        inverse_depth: (n,) in units of their median; NaN where the prior is invalid.
        reliability: (n,) in 0..1, low on depth edges.
        unit: that median, in the unit of the prior's map.
        free_shift: whether the inverse depth is known up to a shift only, as networks of relative depth give it.
    """

    inverse_depth: Array
    reliability: Array
    unit: float
    free_shift: bool = True

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(n,) where the prior is used: finite, reliable and not too far away."""
        is_near = self.inverse_depth > _LEAST_INVERSE_DEPTH
        return np.isfinite(self.inverse_depth) & (self.reliability > _LEAST_RELIABILITY) & is_near

    def padded(self, count: int) -> ImageDepth:
        """With `count` further keypoints, at which the prior is not valid."""
        none = np.zeros(count)
        return replace(self, inverse_depth=np.r_[self.inverse_depth, none], reliability=np.r_[self.reliability, none])

    def of(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> ImageDepth:
        """At some of the n keypoints, by a mask or by indices."""
        return replace(self, inverse_depth=self.inverse_depth[kept], reliability=self.reliability[kept])
