"""Test objects for a solved scene: the plane that most points support, a grid on it, and cubes that stand on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.alignment.planes import Plane, find_plane
from factorsfm.result.reconstruction import Reconstruction

Array = NDArray[np.float64]

_CELL = 0.1  # side of a cell as a share of the picture's width, at most, at the typical distance of the plane
_MOST_CELLS = 40  # along a side of the grid
_CUBES = 3
_CENTRAL = 0.7  # share of the width and height of the picture in which the cubes start


@dataclass(frozen=True, slots=True)
class Props:
    """What is locked into the scene, in world coordinates.

    Attributes:
        plane: on which it stands.
        cell: side of a cell of the grid, and of a cube.
        grid: (lines, points, 3).
        cubes: (n, 8, 3) corners: four on the plane, in turn, and the four above them.
    """

    plane: Plane
    cell: float
    grid: Array
    cubes: Array


def place_props(reconstruction: Reconstruction) -> Props:
    """Find the plane and lay out grid and cubes, always the same for the same reconstruction.

    Raises:
        InputError: there is no camera or there are too few points.
    """
    plane = find_plane(reconstruction)
    camera = reconstruction.camera
    away = np.linalg.norm(reconstruction.points[plane.support] - reconstruction.camera_centers().mean(axis=0), axis=1)
    seen = _CELL * float(np.median(away)) * camera.width / camera.focal_length_x
    cell = _round_length(max(seen, 2 * float(np.ptp(plane.extent, axis=0).max()) / _MOST_CELLS))
    low, high = np.floor(plane.extent[0] / cell), np.ceil(plane.extent[1] / cell)
    along, across = (np.arange(a, b + 1) * cell for a, b in zip(low, high, strict=True))
    steps = np.linspace(0, 1, 65)
    lines = [np.column_stack([np.full(65, a), across[0] + steps * np.ptp(across), np.zeros(65)]) for a in along]
    lines += [np.column_stack([along[0] + steps * np.ptp(along), np.full(65, a), np.zeros(65)]) for a in across]
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    cube = cell * np.concatenate([square, square + [0, 0, 1]])
    corners = np.floor(_spread(reconstruction, plane) / cell) * cell
    cubes = np.array([cube + [*corner, 0] for corner in np.unique(corners, axis=0)])
    return Props(plane, cell, plane.world(np.array(lines)), plane.world(cubes))


def _spread(reconstruction: Reconstruction, plane: Plane) -> Array:
    """(n, 2) coordinates on the plane of supporting points that are well inside the middle picture and far apart."""
    poses = [frame.cam_from_world for frame in reconstruction.frames if frame.cam_from_world is not None]
    camera = reconstruction.camera_of(reconstruction.registered[len(poses) // 2])
    points = reconstruction.points[plane.support]
    flat = (points - plane.origin) @ plane.axes[:2].T
    inner = (flat >= plane.extent[0]).all(axis=1) & (flat <= plane.extent[1]).all(axis=1)
    in_camera = np.asarray(poses[len(poses) // 2] * points)
    in_camera[in_camera[:, 2] <= 0] = np.nan
    seen = np.asarray(camera.img_from_cam(in_camera)) / [camera.width, camera.height]
    inner &= (np.abs(seen - 0.5) < _CENTRAL / 2).all(axis=1)
    if not inner.any():
        return np.zeros((1, 2))
    seen, flat = seen[inner], flat[inner]
    chosen = [int(np.argmin(np.linalg.norm(seen - np.median(seen, axis=0), axis=1)))]
    while len(chosen) < min(_CUBES, len(seen)):
        apart = np.linalg.norm(seen[:, None] - seen[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(apart)))
    return np.asarray(flat[chosen])


def _round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `most`."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= most * 1.0001))
