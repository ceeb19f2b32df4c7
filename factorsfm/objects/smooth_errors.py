"""Errors that are alike all over an object in one frame: they move its pose, and leave no residuals.

Those of a scene are inferred from residuals of neighbours (`adjustment.shared_errors`). Of a thing that is hardly
larger than the reach of such errors nearly all goes into its pose, so that nothing is left to infer them from. They are
taken to be those of scenes.
"""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.polish.polished import Polished
from factorsfm.support.rotations import adjoint, cross_matrices

Array = NDArray[np.float64]

# Standard deviation (pixels), and share of the image's width in ``1 / (1 + distance / reach)``. The law of
# `shared_errors`: on rendered, compressed scenes it is met with 0.016 to 0.024 pixels.
_SIGMA_PX, _REACH = 0.02, 1.0 / 48.0


def smooth_error_covariance(polished: Polished, width: int) -> Array:
    """(k, 6, 6) what the smooth errors of each frame and of the first one add to `Polished.covariance`.

    Args:
        width: of the image, pixels.
    """
    found = _by_frame(polished, width)
    state = polished.state
    cam_from_object = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        for rotation, translation in zip(state.rotation, state.translation, strict=True)
    ]
    # An error of the first pose is seen in all others, which are relative to it.
    relative = [pose * cam_from_object[0].inverse() for pose in cam_from_object]
    carried = np.array([adjoint(pose.rotation.matrix(), pose.translation) for pose in relative])
    found += carried @ found[0] @ carried.transpose(0, 2, 1)
    found[0] = 0.0
    return found


def _by_frame(polished: Polished, width: int) -> Array:
    """(k, 6, 6) covariance of each pose by the smooth error of its frame."""
    state, o = polished.state, polished.observations
    seen = state.camera_points(o.frame, o.point) / state.inverse_distance[o.point, None]
    x, y, z = seen.T
    zero, focal = np.zeros_like(z), state.focal[o.frame]
    by_point = np.stack([focal / z, zero, -focal * x / z**2, zero, focal / z, -focal * y / z**2], 1).reshape(-1, 2, 3)
    # The pose is world_from_cam, perturbed on the right, rotation first.
    by_pose = np.concatenate([by_point @ cross_matrices(seen), -by_point], axis=2)
    weight = 1.0 / polished.observation_sigma**2
    found = np.zeros((len(state.rotation), 6, 6))
    for frame in range(len(found)):
        rows = np.flatnonzero(o.frame == frame)
        derivative, pixels = by_pose[rows], o.pixels[rows]
        pull = derivative * weight[rows, None, None]
        gain = np.linalg.pinv(np.einsum("ndi,ndj->ij", pull, derivative), hermitian=True)
        distance = np.linalg.norm(pixels[:, None] - pixels, axis=2)
        alike = _SIGMA_PX**2 / (1.0 + distance / (_REACH * width))
        found[frame] = gain @ np.einsum("ndi,nm,mdj->ij", pull, alike, pull, optimize=True) @ gain
    return found
