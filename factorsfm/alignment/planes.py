"""Planes that many points of a result lie on, and the ground among them."""

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
TOLERANCE = 0.01  # of the distance from the camera, within which a point lies on a plane
_GROUND_SLOPE = np.cos(np.radians(35))  # between a ground's normal and the camera's vertical
_GROUND_SHARE, _ANY_SHARE = 0.06, 0.2  # of the points that must support a ground, or any plane
_BELOW_GROUND = 0.1  # share of the points that may lie clearly below a ground: more are below a table
_FEWEST = 15
_BREADTH = 0.12  # of the supporting points across their longest direction: a line supports every plane through it


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


def find_plane(reconstruction: Reconstruction) -> Plane:
    """The ground to which the result is aligned, or on which enough points lie; else the plane with most points, else
    one at the median distance.

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

    if reconstruction.alignment is not None and reconstruction.alignment.ground_height is not None:
        up = np.array([0.0, -1.0, 0.0])
        above = points @ up - (reconstruction.alignment.ground_height - float(center @ up))
        on = np.flatnonzero(np.abs(above) < TOLERANCE * distance)
        if len(on) >= _FEWEST:
            origin = points[on].mean(axis=0) - np.mean(above[on]) * up
            return _with_axes(points, origin, up, view[0], "ground", on, center, rows)
    planes = _planes(points, distance)
    level = [plane for plane in planes if -plane[1] @ view[1] > _GROUND_SLOPE]
    grounds = [
        (origin, up, support)
        for origin, up, support in level
        if np.mean((points - origin) @ up < -2 * TOLERANCE * distance) < _BELOW_GROUND
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
    return np.asarray(normals[np.argmax((off < TOLERANCE).sum(axis=0))])


def _refined(points: Array, distance: Array, normal: Array) -> tuple[Array, Array, NDArray[np.int64], bool]:
    """Origin, unit normal towards the cameras, support, and whether that is a broad patch, no line."""
    up = -normal / np.linalg.norm(normal)
    offset = -1 / float(np.linalg.norm(normal))  # up @ x = offset
    for _ in range(5):
        support = np.flatnonzero(np.abs(points @ up - offset) < TOLERANCE * distance)
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
