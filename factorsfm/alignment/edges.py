"""Up from straight edges in the images: those that meet in one vertical vanishing point, and level ones.

The edges are sought in a few frames and turned into the world with the solved poses, where all frames speak at once.
The plane through a camera and an edge contains the edge's direction. So up is at right angles to the normals of the
planes of all vertical edges, and to the directions of the level ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.support.rotations import exponential
from factorsfm.support.semidefinite import covariance_of, solution

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FRAMES = 6  # that are looked at: more show the same edges again
KNOWN_DEGREES = 1.0  # standard deviation from which on the edges do not tell up: two of them are 2 degrees
_LEAST_LENGTH = 0.03  # of an edge, of the image's larger side
_EDGE_SIGMA = np.radians(0.2)  # of an edge that should be plumb or level
_END_SIGMA_PX = 0.7  # of the ends of an edge beside its line
_PLUMB_DEGREES = 0.3  # to which walls and furniture are plumb
_CONE = np.cos(np.radians(40.0))  # around the camera's up, in which up is sought
_PAIRS = 6000
_MODES, _APART = 6, np.cos(np.radians(2.0))  # vertical vanishing points that are tried
_LEVEL_DIRECTIONS = 2  # of level edges: a third may be that of a ramp
_LEAST_LEVEL = 0.04, 2.5  # of the edges' length along a level direction: of all, and of that along any
_LEAST_EDGES = 30
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Edges:
    """Straight edges.

    Attributes:
        normal: (n, 3) of the plane through the camera and the edge, world; length: (n,) of the edge, pixels.
        frames: number of the images that they are from.
    """

    normal: Array
    length: Array
    frames: int

    @property
    def sigma(self) -> Array:
        """(n,) standard deviation of the direction of each edge, radians."""
        return np.asarray(np.hypot(_EDGE_SIGMA, _END_SIGMA_PX / self.length))


def find_edges(views: Iterable[tuple[Image, pycolmap.Camera, pycolmap.Rigid3d]]) -> Edges:
    """The edges in images (h, w, 3) BGR with their lenses and poses `cam_from_world`."""
    detector = cv2.createLineSegmentDetector()
    normals, lengths, frames = [np.empty((0, 3))], [np.empty(0)], 0
    for image, camera, pose in views:
        frames += 1
        found = detector.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))[0]
        if found is None:
            continue
        ends = found.reshape(-1, 2, 2).astype(np.float64)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        long = length > _LEAST_LENGTH * max(image.shape)
        rays = np.asarray(camera.cam_from_img(ends[long].reshape(-1, 2) + PIXEL_CENTER)).reshape(-1, 2, 2)
        rays = np.concatenate([rays, np.ones((len(rays), 2, 1))], axis=2)
        normal = np.cross(rays[:, 0], rays[:, 1])
        size = np.linalg.norm(normal, axis=1)
        known = np.isfinite(size) & (size > 0)  # a lens may have no inverse in the corners
        normals.append(normal[known] / size[known, None] @ pose.rotation.matrix())
        lengths.append(length[long][known])
    return Edges(np.concatenate(normals), np.concatenate(lengths), frames)


def up_from_edges(edges: Edges, camera_up: Array) -> tuple[Array, float] | None:
    """(3,) up in the world, and its standard deviation about the worst axis, degrees.

    None where the edges do not tell.

    Args:
        camera_up: (3,) up of the cameras in their mean; up is sought within 40 degrees of it.
    """
    if len(edges.length) < _LEAST_EDGES:
        return None
    found = [_refined(edges, up) for up in _vertical_modes(edges, camera_up)]
    if not found:
        return None
    up, std, _ = max(found, key=lambda mode: mode[2])
    std = float(np.hypot(std, _PLUMB_DEGREES))
    return (up, std) if std <= KNOWN_DEGREES and up @ camera_up > _CONE else None


def _support(edges: Edges, directions: Array) -> Array:
    """(n, d) between 0 and 1: how well each edge points along each direction (d, 3)."""
    return np.asarray(np.exp(-0.5 * (edges.normal @ directions.T / edges.sigma[:, None]) ** 2))


def _vertical_modes(edges: Edges, camera_up: Array) -> list[Array]:
    """Directions along which many edges may be vertical, best first."""
    weight = edges.length * (np.abs(edges.normal @ camera_up) < np.sqrt(1 - _CONE**2))
    if np.count_nonzero(weight) < 2:
        return []
    pairs = np.random.default_rng(0).choice(len(weight), (_PAIRS, 2), p=weight / weight.sum())
    crossed = np.cross(edges.normal[pairs[:, 0]], edges.normal[pairs[:, 1]])
    size = np.linalg.norm(crossed, axis=1)
    apart = size > np.sin(np.radians(0.6))  # else their directions hardly meet in a point
    up = crossed[apart] / size[apart, None]
    up *= np.sign(up @ camera_up)[:, None]
    up = up[up @ camera_up > _CONE]
    modes: list[Array] = []
    for k in np.argsort(-(edges.length @ _support(edges, up))):
        if all(up[k] @ mode < _APART for mode in modes):
            modes.append(up[k])
        if len(modes) == _MODES:
            break
    return modes


def _refined(edges: Edges, up: Array) -> tuple[Array, float, float]:
    """Up to which vertical and level edges agree, its standard deviation in degrees, and the length of these edges."""
    std = 90.0
    axes = up[None]
    for _ in range(_ROUNDS):
        axes = np.vstack([up, _level_directions(edges, up)])
        for _ in range(8):
            axes, std = _step(edges, axes)
        up = axes[0]
    return up, std, float(edges.length @ _support(edges, axes).max(axis=1))


def _level_directions(edges: Edges, up: Array) -> Array:
    """(d, 3) directions at right angles to up along which many of the other edges point."""
    x, y = _across(up)
    angle = np.radians(np.arange(0, 180, 0.25))[:, None]
    directions = np.cos(angle) * x + np.sin(angle) * y
    support = _support(edges, directions)
    left = edges.length * (1 - _support(edges, up[None])[:, 0])
    found = np.empty((0, 3))
    for _ in range(_LEVEL_DIRECTIONS):
        along = left @ support
        best = int(np.argmax(along))
        if along[best] < max(_LEAST_LEVEL[0] * edges.length.sum(), _LEAST_LEVEL[1] * float(np.median(along))):
            break
        found = np.vstack([found, directions[best]])
        left = left * (1 - support[:, best])
    return found


def _step(edges: Edges, axes: Array) -> tuple[Array, float]:
    """One step of re-weighted least squares: two angles of up, one of each level direction about up.

    The same edges are seen in every frame: together they say as much as those of one.
    """
    up, (x, y) = axes[0], _across(axes[0])
    size = len(axes) + 1
    normal, gradient, information = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    residual = edges.normal @ axes.T
    support = _support(edges, axes)
    weight = support**2 / np.maximum(support.sum(axis=1, keepdims=True), 1e-12) / edges.sigma[:, None] ** 2
    for k, axis in enumerate(axes):
        jacobian = np.zeros((len(residual), size))
        jacobian[:, :2] = edges.normal @ np.column_stack([np.cross(x, axis), np.cross(y, axis)])
        if k:
            jacobian[:, 1 + k] = edges.normal @ np.cross(up, axis)
        information += (jacobian * weight[:, k : k + 1]).T @ jacobian
        longer = weight[:, k] * edges.length
        normal += (jacobian * longer[:, None]).T @ jacobian
        gradient += jacobian.T @ (longer * residual[:, k])
    step = -solution(normal + 1e-9 * np.trace(normal) * np.eye(size), gradient)
    tilt = exponential((step[0] * x + step[1] * y)[None])[0]
    turned = [axis if k == 0 else exponential((step[1 + k] * up)[None])[0] @ axis for k, axis in enumerate(axes)]
    covariance = edges.frames * covariance_of(information + 1e-9 * np.trace(information) * np.eye(size))
    std = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
    return np.array([tilt @ axis for axis in turned]), std


def _across(up: Array) -> tuple[Array, Array]:
    """Two unit vectors at right angles to a unit vector and to each other."""
    x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x = x / np.linalg.norm(x)
    return x, np.cross(up, x)
