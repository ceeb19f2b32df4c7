"""Test objects for a solved scene: the plane that most points support, a grid on it, and cubes that stand on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

_PLANES = 5  # that are looked for
_TRIPLES = 500
_MAX_POINTS = 4000
_TOLERANCE = 0.01  # of the distance from the camera, within which a point lies on a plane
_GROUND_SLOPE = np.cos(np.radians(35))  # between a ground's normal and the camera's vertical
_GROUND_SHARE, _ANY_SHARE = 0.06, 0.2  # of the points that must support a ground, or any plane
_BELOW_GROUND = 0.1  # share of the points that may lie clearly below a ground: more are below a table
_FEWEST = 15
_BREADTH = 0.12  # of the supporting points across their longest direction: a line supports every plane through it
_CELL = 0.1  # side of a cell as a share of the picture's width, at most, at the typical distance of the plane
_MOST_CELLS = 40  # along a side of the grid
_CUBES = 3
_CENTRAL = 0.7  # share of the width and height of the picture in which the cubes start


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane with its own axes.

    Attributes:
        origin: (3,) amid the points that support it.
        axes: (3, 3), rows: along (the camera's right), across, and up, towards the cameras.
        extent: (2, 2) lowest and highest coordinates, along and across, of nearly all supporting points.
        kind: "ground", "plane" (steeper), or "distance" where no plane was found: at right angles to the view at the
            median distance.
        support: (n,) rows of the points on it.
    """

    origin: Array
    axes: Array
    extent: Array
    kind: str
    support: NDArray[np.int64]

    def world(self, coordinates: Array) -> Array:
        """World coordinates (..., 3) from those along, across and up (..., 3)."""
        return np.asarray(coordinates @ self.axes + self.origin)


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


def find_plane(reconstruction: Reconstruction) -> Plane:
    """The ground if enough points lie on one, else the plane with most points, else one at the median distance.

    Raises:
        InputError: there is no camera or there are too few points.
    """
    poses = [frame.cam_from_world for frame in reconstruction.frames if frame.cam_from_world is not None]
    rows = np.flatnonzero(np.isfinite(reconstruction.points).all(axis=1))
    if not poses or len(rows) < _FEWEST:
        raise InputError(
            f"{len(poses)} cameras and {len(rows)} points give no hold to a grid; "
            f"a camera and {_FEWEST} points are needed"
        )
    view = np.sum([pose.rotation.matrix() for pose in poses], axis=0)
    view /= np.linalg.norm(view, axis=1, keepdims=True)  # rows: right, down, forward
    center = np.mean([pose.inverse().translation for pose in poses], axis=0)
    points = reconstruction.points[rows] - center
    distance = np.linalg.norm(points, axis=1)

    planes = _planes(points, distance)
    level = [plane for plane in planes if -plane[1] @ view[1] > _GROUND_SLOPE]
    grounds = [
        (origin, up, support)
        for origin, up, support in level
        if np.mean((points - origin) @ up < -2 * _TOLERANCE * distance) < _BELOW_GROUND
    ]
    for kind, found, share in (("ground", grounds, _GROUND_SHARE), ("plane", planes, _ANY_SHARE)):
        origin, up, support = max(found, key=lambda plane: len(plane[2]), default=(view[2], view[2], rows[:0]))
        if len(support) >= share * len(rows):
            return _with_axes(points, origin, up, view[0], kind, support, center, rows)
    near = np.argsort(np.abs(distance - np.median(distance)))[: max(_FEWEST, len(rows) // 4)]
    origin = view[2] * np.median(points @ view[2])
    return _with_axes(points, origin, -view[2], view[0], "distance", near, center, rows)


def _planes(points: Array, distance: Array) -> list[tuple[Array, Array, NDArray[np.int64]]]:
    """Origin, unit normal towards the cameras, and support of the planes, one after the other.

    Each takes its points away from those that follow: else any plane that cuts a wall is supported along the cut.
    """
    generator = np.random.default_rng(0)
    left = np.arange(len(points))
    found = []
    for _ in range(_PLANES):
        if len(left) < _FEWEST:
            break
        normal = _best_triple(points[left], distance[left], generator)
        if normal is None:
            break
        origin, up, support, broad = _refined(points[left], distance[left], normal)
        if broad:
            found.append((origin, up, left[support]))
        left = np.delete(left, support)
    return found


def _best_triple(points: Array, distance: Array, generator: np.random.Generator) -> Array | None:
    """(3,) `normal` of the plane ``normal @ x = 1`` through three points that lies close to most others."""
    sample = generator.permutation(len(points))[:_MAX_POINTS]
    triples = points[generator.choice(sample, (_TRIPLES, 3))]
    regular = np.abs(np.linalg.det(triples)) > 1e-9 * np.prod(np.linalg.norm(triples, axis=2), axis=1)
    if not regular.any():
        return None
    normals = np.linalg.solve(triples[regular], np.ones((int(regular.sum()), 3, 1)))[..., 0]
    off = np.abs(points[sample] @ normals.T - 1) / (np.linalg.norm(normals, axis=1) * distance[sample, None])
    return np.asarray(normals[np.argmax((off < _TOLERANCE).sum(axis=0))])


def _refined(points: Array, distance: Array, normal: Array) -> tuple[Array, Array, NDArray[np.int64], bool]:
    """Origin, unit normal towards the cameras, support, and whether that is a broad patch, no line."""
    up = -normal / np.linalg.norm(normal)
    offset = -1 / float(np.linalg.norm(normal))  # up @ x = offset
    for _ in range(5):
        support = np.flatnonzero(np.abs(points @ up - offset) < _TOLERANCE * distance)
        weight = 1 / distance[support, None]
        origin = (weight * points[support]).sum(axis=0) / weight.sum()
        _, spread, axes = np.linalg.svd(weight * (points[support] - origin))
        up = axes[2] if axes[2] @ origin < 0 else -axes[2]
        offset = float(up @ origin)
    return origin, up, support, len(support) >= _FEWEST and bool(spread[1] >= _BREADTH * spread[0])


def _with_axes(
    points: Array,
    origin: Array,
    up: Array,
    right: Array,
    kind: str,
    support: NDArray[np.int64],
    center: Array,
    rows: NDArray[np.int64],
) -> Plane:
    along = right - (right @ up) * up
    along /= np.linalg.norm(along)
    axes = np.array([along, np.cross(up, along), up])
    flat = (points[support] - origin) @ axes[:2].T
    extent = np.percentile(flat, [4, 96], axis=0)
    return Plane(origin + center, axes, extent, kind, rows[support])


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
