"""What one update of the keyframe graph is about: keyframes, landmarks, and what was measured of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.residuals import camera_points

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class DepthMeasurements:
    """Values of the depth prior at landmarks.

    Attributes:
        image: (p,) rows of the keyframes that carry a prior; scale, shift: (p,) affines of these, as far as known.
        row: (d,) which of these each value belongs to; point: (d,) row of its landmark.
        inverse_depth: (d,) values; sigma: (d,) standard deviations, in units of the prior.
        scale_sigma, shift_sigma: how well every affine is known beforehand, around 1 (times `Window.unit`) and 0.
    """

    image: Index
    scale: Array
    shift: Array
    row: Index
    point: Index
    inverse_depth: Array
    sigma: Array
    scale_sigma: float
    shift_sigma: float


@dataclass(frozen=True, slots=True)
class Window:
    """Keyframes and landmarks with their present values, and the measurements that join them.

    Attributes:
        keyframes: (k,) index of the frame of each in its source, in the order in which they joined the map;
            constant: (k,) which poses do not change, the same or others than in the window before.
        rotation (k, 3, 3), translation (k, 3): `cam_from_world`.
        ids: (n,) tracks, ascending; points: (n, 3) landmarks in the world.
        frame, point: (m,) rows of the keyframe and of the landmark of each observation.
        pixels: (m, 2) undistorted observations, pixels relative to the principal point.
        focal: pixels; sigma: standard deviation of an observation, pixels.
        depths: of the prior, or None.
        unknown_lens: whether the focal length is a variable; open_lens: whether it may be estimated now.
        unit: how many times as long lengths are as when the map began; unit_held: whether factors of the caller
            determine it.
    """

    keyframes: Index
    constant: Mask
    rotation: Array
    translation: Array
    ids: Index
    points: Array
    frame: Index
    point: Index
    pixels: Array
    focal: float
    sigma: float
    depths: DepthMeasurements | None = None
    unknown_lens: bool = False
    open_lens: bool = False
    unit: float = 1.0
    unit_held: bool = False

    @property
    def solved(self) -> Mask:
        """(k,) keyframes whose poses are solved for: neither constant nor, where none is constant, the world."""
        first = np.arange(len(self.keyframes)) == 0
        return np.asarray(~self.constant & ~(first & (not self.constant.any())))

    def reprojection(self) -> tuple[Array, Array]:
        """(m,) distances between predicted and observed pixels, and (m,) depths in the cameras."""
        q = camera_points(
            self.rotation[self.frame], self.translation[self.frame], self.points[self.point], np.ones(len(self.frame))
        )
        depth = np.maximum(q[:, 2], 1e-6)
        return np.linalg.norm(self.focal * q[:, :2] / depth[:, None] - self.pixels, axis=1), q[:, 2]

    def scaled(self, unit: float) -> Window:
        """The same in another unit of length: all lengths `unit` times as long."""
        depths = self.depths
        if depths is not None:
            depths = replace(depths, scale=depths.scale * unit)
        return replace(self, translation=self.translation * unit, points=self.points * unit, depths=depths)
