"""Images of a rolling shutter: each row shows what the camera sees at the time at which the row is read."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER, normalized_from_pixels, pixels_from_normalized
from factorsfm.synthetic.scene import Floats

_ITERATIONS = 3  # of the fixed point that finds which pixel of the image a pixel of the result shows


def read_by_rows(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: pycolmap.Camera,
    path: Sequence[pycolmap.Rigid3d],
    frame: int,
    readout: float,
) -> NDArray[np.uint8]:
    """The image as a rolling shutter reads it, row by row; the row of the principal point has the time of its pose.

    Every pixel is taken from the given image. What only the motion during the readout uncovers is not in it; the result
    shows the surroundings there.

    Args:
        image: (h, w, 3) of the frame, read at once.
        depth: z-depth of any size, in the unit of the path, above 0 everywhere.
        camera: the lens.
        path: cam_from_world of all frames.
        frame: the frame's position in `path`.
        readout: time from the first row to the last, in frames.

    Returns:
        (h, w, 3) uint8.
    """
    height, width = image.shape[:2]
    rows = np.arange(height)
    row_time = readout * (rows + PIXEL_CENTER - camera.principal_point_y) / height
    rotations, translations = _row_from_frame(path, frame, row_time)
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), rows.astype(np.float64))
    wanted = np.stack([x, y], -1)
    source = wanted
    for _ in range(_ITERATIONS):
        ray = normalized_from_pixels(camera, source.reshape(-1, 2)).reshape(height, width, 2)
        on_map = (source + PIXEL_CENTER) * [depth.shape[1] / width, depth.shape[0] / height] - PIXEL_CENTER
        z = cv2.remap(depth, on_map.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        point = np.concatenate([ray, np.ones((height, width, 1))], 2) * z[:, :, None]
        in_row = np.einsum("rij,rcj->rci", rotations, point) + translations[:, None]
        seen = pixels_from_normalized(camera, (in_row[..., :2] / in_row[..., 2:]).reshape(-1, 2)).reshape(source.shape)
        source = source - (seen - wanted)
    return np.asarray(
        cv2.remap(image, source.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def _row_from_frame(path: Sequence[pycolmap.Rigid3d], frame: int, times: Floats) -> tuple[Floats, Floats]:
    """Rotations (n, 3, 3) and translations (n, 3) from the camera of a frame to the camera at n other times.

    The motion is a parabola through the cameras of the frames before and after; it is a straight line at the ends of
    the path.

    Args:
        times: (n,) from that of the frame, in frames.
    """
    world_from_cam = path[frame].inverse()
    before, after = (
        _as_vector(path[k] * world_from_cam)
        if 0 <= k < len(path)
        else -_as_vector(path[2 * frame - k] * world_from_cam)
        for k in (frame - 1, frame + 1)
    )
    motion = times[:, None] * 0.5 * (after - before) + times[:, None] ** 2 * 0.5 * (after + before)
    rotations = np.array([pycolmap.Rotation3d(vector).matrix() for vector in motion[:, :3]])
    return rotations, motion[:, 3:]


def _as_vector(pose: pycolmap.Rigid3d) -> Floats:
    """(6,) rotation vector and translation."""
    rotation, _ = cv2.Rodrigues(pose.rotation.matrix())
    return np.concatenate([np.ravel(rotation), pose.translation])
