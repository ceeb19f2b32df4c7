"""A textured room with boxes, rendered by ray casting: images and exact depth."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.synthetic.scene import FIELD_OF_VIEW, Floats

_FINER = 4.0  # how many times smaller the patterns of a moving box are than those of the room


class Room:
    """A room with boxes, 2 to 7 units in front of a camera at the identity; it has no wall behind that camera.

    Args:
        seed: of the boxes and their textures.
        focal_length: pixels; an image with it resolves about one texel per pixel.
    """

    def __init__(self, seed: int, focal_length: float) -> None:
        self._quads = _quads(np.random.default_rng(seed))
        self._textures = _textures(seed, self._quads, focal_length)
        self._things = len(self._quads)  # the first quad that is none of the room

    def with_box(self, box: MovingBox, world_from_box: pycolmap.Rigid3d) -> Room:
        """The same room with a box in it."""
        room = copy(self)
        room._quads, room._textures = self._quads + box.quads(world_from_box), self._textures + box.textures
        return room

    def box_mask(self, camera: pycolmap.Camera, pose: pycolmap.Rigid3d) -> NDArray[np.bool_]:
        """(h, w) the pixels whose centres show a box of `with_box`; `pose` is cam_from_world."""
        return np.asarray(_cast(self._quads, camera, pose, 1).quad >= self._things)

    def depth(self, camera: pycolmap.Camera, pose: pycolmap.Rigid3d) -> Floats:
        """(h, w) exact z-depth at the pixel centres, world units; `pose` is cam_from_world."""
        return np.asarray(1 / _cast(self._quads, camera, pose, 1).inverse_depth, np.float64)

    def image(self, camera: pycolmap.Camera, pose: pycolmap.Rigid3d) -> NDArray[np.uint8]:
        """(h, w, 3) BGR, the mean of two by two samples per pixel; `pose` is cam_from_world."""
        return _render(self._quads, self._textures, camera, pose)


class MovingBox:
    """A textured box that may stand anywhere; its own axes run along its edges, its origin is its middle.

    Args:
        size: (3,) world units; seed: of its textures.
        first: world_from_box where its textures are as fine as an image with `focal_length` (pixels) resolves.
    """

    def __init__(self, size: Floats, first: pycolmap.Rigid3d, seed: int, focal_length: float) -> None:
        self._size = size
        # What looks the same, four times as large and as far away: its patterns are a quarter of those of the room.
        large = _box(_FINER * first.translation, _FINER * size, first.rotation)
        self.textures = _textures(seed, large, focal_length)

    def quads(self, world_from_box: pycolmap.Rigid3d) -> list[_Quad]:
        """Its faces, in the order of `textures`."""
        return _box(world_from_box.translation, self._size, world_from_box.rotation)


@dataclass(frozen=True, slots=True, eq=False)
class _Quad:
    """A parallelogram: ``origin + u * edges[0] + v * edges[1]``, u and v from 0 to 1; `shade` scales its brightness."""

    origin: Floats
    edges: Floats
    shade: float


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """What the rays of the pixels of an image hit.

    Attributes:
        quad: (h, w) position in the list of quads.
        uv: (2, h, w) place on the quad.
        inverse_depth: (h, w) 1 / z.
    """

    quad: NDArray[np.int16]
    uv: NDArray[np.floating]
    inverse_depth: NDArray[np.floating]


def _quads(generator: np.random.Generator) -> list[_Quad]:
    left, right, ceiling, floor, behind, back = -2.3, 2.3, -1.4, 1.1, -1.0, 7.0
    x, y, z = np.diag([right - left, floor - ceiling, back - behind])
    corner = np.array([left, ceiling, behind])
    quads = [
        _Quad(corner + y, np.array([x, z]), 0.9),
        _Quad(corner, np.array([x, z]), 0.7),
        _Quad(corner + z, np.array([x, y]), 1.0),
        _Quad(corner, np.array([z, y]), 0.8),
        _Quad(corner + x, np.array([z, y]), 0.75),
    ]
    for i, depth in enumerate(np.linspace(2.8, 6.2, 9)):  # boxes on the floor, right and left in turn
        size = generator.uniform([0.4, 0.6, 0.4], [0.8, 1.5, 0.8]) * [depth / 5, 1, depth / 5]
        middle = (-1) ** i * generator.uniform(0.15, 0.6) * depth * np.tan(FIELD_OF_VIEW / 2)
        quads += _box(np.array([np.clip(middle, -1.7, 1.7), floor - size[1] / 2, depth]), size, _turn(generator))
    for depth in np.linspace(3.2, 5.7, 4):  # boxes at the ceiling
        size = generator.uniform([0.3, 0.3, 0.3], [0.7, 0.7, 0.7])
        middle = generator.uniform(-0.8, 0.8) * depth * np.tan(FIELD_OF_VIEW / 2)
        quads += _box(np.array([np.clip(middle, -1.7, 1.7), ceiling + size[1] / 2, depth]), size, _turn(generator))
    return quads


def _turn(generator: np.random.Generator) -> pycolmap.Rotation3d:
    """About the vertical by up to 40 degrees."""
    return pycolmap.Rotation3d(np.array([0, np.radians(generator.uniform(-40, 40)), 0]))


def _box(center: Floats, size: Floats, rotation: pycolmap.Rotation3d) -> list[_Quad]:
    """The six faces of a box."""
    x, y, z = rotation.matrix().T * size[:, None]
    corner = center - (x + y + z) / 2
    faces = [(x, y, z, 0.9), (z, y, x, 0.7), (x, z, y, 1.0)]
    return [
        _Quad(corner + offset, np.array([u, v]), shade)
        for u, v, across, shade in faces
        for offset in (np.zeros(3), across)
    ]


def _cast(quads: list[_Quad], camera: pycolmap.Camera, pose: pycolmap.Rigid3d, oversampling: int) -> _Hits:
    """The nearest quad on the ray of every pixel; exact, because u/z, v/z and 1/z are linear in the pixel."""
    dtype = np.float64 if oversampling == 1 else np.float32  # depth must be exact, colours need not
    width, height = oversampling * camera.width, oversampling * camera.height
    focal_length = oversampling * camera.focal_length_x
    x = ((np.arange(width) + PIXEL_CENTER - width / 2) / focal_length).astype(dtype)
    y = ((np.arange(height)[:, None] + PIXEL_CENTER - height / 2) / focal_length).astype(dtype)
    hit_quad = np.full((height, width), -1, dtype=np.int16)
    nearest = np.zeros((3, height, width), dtype=dtype)  # u/z, v/z, 1/z
    for i, quad in enumerate(quads):
        corners = pose * (quad.origin + np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) @ quad.edges)
        window = np.s_[:, :]
        if corners[:, 2].min() > 0:
            corner_x, corner_y = (corners[:, :2] / corners[:, 2:]).T
            columns, rows = (
                slice(*np.searchsorted(axis, [ends.min(), ends.max()]))
                for axis, ends in ((x, corner_x), (y[:, 0], corner_y))
            )
            window = np.s_[rows, columns]
        on_quad = np.linalg.inv(np.column_stack([pose.rotation.matrix() @ quad.edges.T, pose * quad.origin]))
        u, v, w = (row[0] * x[window[1]] + (row[1] * y[window[0]] + row[2]) for row in on_quad.astype(dtype))
        seam = 1e-6  # overlap of neighbouring quads, so that no ray passes between them
        hit = (w > nearest[2][window]) & (u >= -seam) & (u <= w + seam) & (v >= -seam) & (v <= w + seam)
        hit_quad[window][hit] = i
        for old, new in zip(nearest, (u, v, w), strict=True):
            old[window][hit] = new[hit]
    return _Hits(hit_quad, nearest[:2] / nearest[2], nearest[2])


def _render(
    quads: list[_Quad], textures: list[NDArray[np.uint8]], camera: pycolmap.Camera, pose: pycolmap.Rigid3d
) -> NDArray[np.uint8]:
    hits = _cast(quads, camera, pose, 2)
    image = np.zeros((*hits.quad.shape, 3), dtype=np.uint8)
    for i in np.unique(hits.quad):
        mask = (hits.quad == i).astype(np.uint8)
        x, y, w, h = cv2.boundingRect(mask)
        window = np.s_[y : y + h, x : x + w]
        size = np.array(textures[i].shape[1::-1])[:, None, None]
        map_x, map_y = (hits.uv[:, *window] * size - PIXEL_CENTER).astype(np.float32)
        color = cv2.remap(textures[i], map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        cv2.copyTo(color, mask[window], image[window])
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _textures(seed: int, quads: list[_Quad], focal_length: float) -> list[NDArray[np.uint8]]:
    return [_texture(np.random.default_rng([seed, i]), quad, focal_length) for i, quad in enumerate(quads)]


def _texture(generator: np.random.Generator, quad: _Quad, focal_length: float) -> NDArray[np.uint8]:
    """(height, width, 3) bricks, blotches with sharp edges and noise of all sizes; about one texel per pixel."""
    middle = quad.origin + quad.edges.sum(axis=0) / 2
    length = np.linalg.norm(quad.edges, axis=1)
    seen = np.linalg.norm(quad.edges[:, :2] - quad.edges[:, 2:] * middle[:2] / middle[2], axis=1)
    width, height = np.clip(focal_length / middle[2] * np.maximum(seen, 0.3 * length), 16, 4096).astype(int)

    first, second = generator.uniform(80, 180, (2, 1)) + generator.uniform(-30, 30, (2, 3))
    blotches = np.clip(0.5 + 3 * _noise(generator, length, width, height, 0.6, 0.1), 0, 1)
    texture = first + (second - first) * blotches[..., None]
    texture += 25 * _noise(generator, length, width, height, 0.4, 0.0)[..., None]

    brick = generator.uniform([0.3, 0.15], [0.6, 0.4])
    u, v = (
        (np.arange(n) + 0.5) / n * side / pitch for n, side, pitch in zip((width, height), length, brick, strict=True)
    )
    row = np.floor(v).astype(int)[:, None]
    along = u[None, :] + 0.5 * (row % 2)
    tint = generator.uniform(-25, 25, (int(row.max()) + 1, int(along.max()) + 1))
    texture += tint[row, along.astype(int)][..., None]
    mortar = (along % 1 < 0.02 / brick[0]) | (v % 1 < 0.02 / brick[1])[:, None]
    texture[mortar] *= 0.55
    return np.asarray(np.clip(quad.shade * texture, 0, 255), dtype=np.uint8)


def _noise(
    generator: np.random.Generator, length: Floats, width: int, height: int, coarsest: float, finest: float
) -> Floats:
    """(height, width) noise of mean 0 and standard deviation 1, the sum of octaves.

    Args:
        length: (2,) extent of the texture in world units.
        coarsest, finest: wavelengths of the first and last octave, in world units; at least three texels.
    """
    total = np.zeros((height, width))
    wavelength = coarsest
    while wavelength >= max(finest, 3 * max(length[0] / width, length[1] / height)) or wavelength == coarsest:
        cells = np.ceil(length / wavelength).astype(int) + 2
        grid = generator.standard_normal((cells[1], cells[0]))
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        wavelength /= 2
    return np.asarray((total - total.mean()) / total.std())
