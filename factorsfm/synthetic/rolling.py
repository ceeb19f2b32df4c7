"""Images as a rolling shutter would have read them: each row from where the camera is at its time."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER, normalized_from_pixels, pixels_from_normalized
from factorsfm.synthetic.scene import Floats

_ROUNDS = 3  # from what is seen at the time of a row back to what the image shows


def read_by_rows(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: pycolmap.Camera,
    path: Sequence[pycolmap.Rigid3d],
    frame: int,
    readout: float,
) -> NDArray[np.uint8]:
    """The image, its rows at the times at which they are read; it is that of the time of its pose in the middle.

    What the motion uncovers while the image is read is not there; the image shows its surroundings then.

    Args:
        image: (h, w, 3) of the frame; depth: z-depth of any size, in the unit of the path, above 0 everywhere.
        camera: the lens; path: cam_from_world of all frames; frame: which of them it is.
        readout: share of the time between two frames that passes from the first row to the last.
    """
    height, width = image.shape[:2]
    rows = np.arange(height)
    turns, moves = _motion(path, frame, readout * (rows + PIXEL_CENTER - camera.principal_point_y) / height)
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), rows.astype(np.float64))
    wanted = np.stack([x, y], -1)
    source = wanted
    for _ in range(_ROUNDS):
        ray = normalized_from_pixels(camera, source.reshape(-1, 2)).reshape(height, width, 2)
        near = (source + PIXEL_CENTER) * [depth.shape[1] / width, depth.shape[0] / height] - PIXEL_CENTER
        z = cv2.remap(depth, near.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        point = np.concatenate([ray, np.ones((height, width, 1))], 2) * z[:, :, None]
        later = np.einsum("rij,rcj->rci", turns, point) + moves[:, None]
        seen = pixels_from_normalized(camera, (later[..., :2] / later[..., 2:]).reshape(-1, 2)).reshape(source.shape)
        source = source - (seen - wanted)
    return np.asarray(
        cv2.remap(image, source.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def _motion(path: Sequence[pycolmap.Rigid3d], frame: int, times: Floats) -> tuple[Floats, Floats]:
    """Rotations (n, 3, 3) and translations (n, 3) from a camera to where it is at times from its own, in frames.

    A parabola through the camera before and the one after; at the ends of the path the motion goes on as it was.
    """
    own = path[frame].inverse()
    before, after = (
        _as_vector(path[k] * own) if 0 <= k < len(path) else -_as_vector(path[2 * frame - k] * own)
        for k in (frame - 1, frame + 1)
    )
    motion = times[:, None] * 0.5 * (after - before) + times[:, None] ** 2 * 0.5 * (after + before)
    turns = np.array([pycolmap.Rotation3d(turn).matrix() for turn in motion[:, :3]])
    return turns, motion[:, 3:]


def _as_vector(pose: pycolmap.Rigid3d) -> Floats:
    turn, _ = cv2.Rodrigues(pose.rotation.matrix())
    return np.concatenate([np.ravel(turn), pose.translation])
