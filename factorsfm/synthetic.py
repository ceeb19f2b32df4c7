"""Synthetic shots with exact truth: projected points, and a rendered room with video, depth and poses.

Every camera path starts at the identity, so the world frame is that of the first camera.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera import PIXEL_CENTER, camera_to_json, with_focal
from factorsfm.errors import InputError

Motion = Literal["dolly", "truck", "handheld", "rotation", "static", "arc"]
Floats = NDArray[np.float64]

FRAMES_PER_SECOND = 24.0
_FIELD_OF_VIEW = np.radians(54.0)


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene:
    """Points seen by a moving camera.

    Attributes:
        points: (n, 3) world coordinates.
        camera: the lens.
        cam_from_world: one pose per frame.
    """

    points: Floats
    camera: pycolmap.Camera
    cam_from_world: list[pycolmap.Rigid3d]

    def observe(self, noise_px: float = 0.0, seed: int = 0) -> list[tuple[NDArray[np.int64], Floats]]:
        """What every frame sees.

        Args:
            noise_px: standard deviation of the Gaussian noise on each coordinate, pixels.
            seed: of the noise.

        Returns:
            Per frame the rows in `points` that project into the image, (k,), and their pixels with centres
            at integers, (k, 2).
        """
        generator = np.random.default_rng(seed)
        observations = []
        for pose in self.cam_from_world:
            xy = np.asarray(self.camera.img_from_cam(pose * self.points)) - PIXEL_CENTER
            size = np.array([self.camera.width, self.camera.height])
            # behind the camera the pixels are NaN, and no comparison holds
            inside = ((xy >= -PIXEL_CENTER) & (xy < size - PIXEL_CENTER)).all(axis=1)
            noisy = xy[inside] + noise_px * generator.standard_normal((int(inside.sum()), 2))
            observations.append((np.flatnonzero(inside), noisy))
        return observations

    def depth(self, frame: int, ids: NDArray[np.int64]) -> Floats:
        """True z-depth (k,) of points in a frame."""
        return np.asarray((self.cam_from_world[frame] * self.points[ids])[:, 2])

    def inverse_depth(
        self,
        frame: int,
        ids: NDArray[np.int64],
        scale: float = 1.0,
        shift: float = 0.0,
        noise: float = 0.0,
        seed: int = 0,
    ) -> Floats:
        """What a depth network says of points in a frame: ``scale / z + shift``, (k,).

        Args:
            frame: position in `cam_from_world`.
            ids: (k,) rows in `points`.
            scale, shift: the affine of this frame.
            noise: standard deviation as a fraction of the scaled median inverse depth.
            seed: of the noise; every frame draws its own.
        """
        inverse = 1 / self.depth(frame, ids)
        sigma = noise * np.median(inverse) if len(inverse) else 0.0
        draw = np.random.default_rng([seed, frame]).standard_normal(len(inverse))
        return scale * (inverse + sigma * draw) + shift


def synthetic_scene(
    motion: Motion = "dolly", frames: int = 30, points: int = 400, parallax: float = 0.03, seed: int = 0
) -> SyntheticScene:
    """Random points between 2 and 8 units in front of a 640x360 camera.

    Args:
        motion: camera path; "rotation" and "static" do not translate.
        frames: number of frames, at least 2.
        points: number of points; some enter or leave the image on the way.
        parallax: largest distance of a camera from the first one over the median depth of all points in the
            first frame, exact.
        seed: of the points and of the handheld sway.

    Raises:
        InputError: an unknown motion, fewer than 2 frames, or a parallax outside 0 to 1.
    """
    camera = room_camera(640, 360)
    generator = np.random.default_rng(seed)
    z = 1 / generator.uniform(1 / 8, 1 / 2, points)
    margin = 1.15  # beyond the border of the first image
    half = margin / 2 * np.array([camera.width, camera.height]) / camera.focal_length_x
    xy = generator.uniform(-half, half, (points, 2)) * z[:, None]
    path = _camera_path(motion, frames, parallax, float(np.median(z)), seed)
    return SyntheticScene(np.column_stack([xy, z]), camera, path)


def room_camera(width: int, height: int) -> pycolmap.Camera:
    """The lens of all synthetic shots, at this size in pixels."""
    focal_length = width / 2 / np.tan(_FIELD_OF_VIEW / 2)
    return pycolmap.Camera(
        camera_id=1,
        model="PINHOLE",
        width=width,
        height=height,
        params=[focal_length, focal_length, width / 2, height / 2],
        has_prior_focal_length=True,
    )


def _camera_path(motion: str, frames: int, parallax: float, depth: float, seed: int) -> list[pycolmap.Rigid3d]:
    """cam_from_world for a path that starts at the identity and strays by parallax * depth at most."""
    if motion not in get_args(Motion):
        raise InputError(f'motion "{motion}" is unknown; one of {", ".join(get_args(Motion))} is expected')
    if frames < 2:
        raise InputError(f"a synthetic shot of {frames} frames was asked for; it needs at least 2")
    if not 0 <= parallax < 1:
        raise InputError(f"a synthetic shot of parallax {parallax:g} was asked for; it must be at least 0 and below 1")
    time = np.linspace(0, 1, frames)
    centers = np.zeros((frames, 3))
    rotations = np.zeros((frames, 3))  # axis times angle, world from camera
    if motion == "dolly":
        centers[:, 2] = time
    elif motion == "truck":
        centers[:, 0] = time
    elif motion == "rotation":
        rotations[:, 1] = np.radians(12) * time
        rotations[:, 0] = np.radians(2) * np.sin(np.pi * time)
    elif motion == "arc":  # around the point in the middle of the image at the median depth
        angle = 2 * np.arcsin(parallax / 2) * time
        centers = np.column_stack([np.sin(angle), np.zeros(frames), 1 - np.cos(angle)])
        rotations[:, 1] = -angle
    elif motion == "handheld":
        generator = np.random.default_rng([seed, 1])
        cycles, phase = generator.uniform(0.5, 2.5, (3, 6)), generator.uniform(0, 2 * np.pi, (3, 6))
        sway = np.sin(2 * np.pi * cycles * time[:, None, None] + phase).sum(axis=1)
        sway -= sway[0]
        centers, rotations = sway[:, :3], np.radians(0.4) * sway[:, 3:]
    reach = np.linalg.norm(centers, axis=1).max()
    if reach > 0:
        centers = centers * (parallax * depth / reach)
    return [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center).inverse()
        for rotation, center in zip(rotations, centers, strict=True)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedShot:
    """A rendered room with exact truth.

    Attributes:
        images: (h, w, 3) uint8 BGR per frame.
        depths: (h, w) float32 per frame: exact z-depth at the pixel centres, world units.
        camera: the lens of the first frame.
        cam_from_world: one pose per frame.
        zoom: (k,) focal length of each frame, relative to the first one.
    """

    images: list[NDArray[np.uint8]]
    depths: list[NDArray[np.float32]]
    camera: pycolmap.Camera
    cam_from_world: list[pycolmap.Rigid3d]
    zoom: Floats


def render_shot(
    motion: Motion = "dolly",
    frames: int = 30,
    width: int = 480,
    height: int = 270,
    parallax: float = 0.05,
    seed: int = 0,
    zoom: float = 1.0,
) -> RenderedShot:
    """Render a textured room with boxes between 2 and 7 units in front of the camera.

    Args:
        motion: camera path; "rotation" and "static" do not translate.
        frames: number of frames, at least 2.
        width, height: pixels.
        parallax: largest distance of a camera from the first one over the median depth of the first image,
            exact; beyond about 0.3 the camera may run into a box.
        seed: of the room, its textures and the handheld sway.
        zoom: focal length of the last frame over that of the first; between them it changes softly.

    Raises:
        InputError: an unknown motion, fewer than 2 frames, a parallax outside 0 to 1, or a zoom that is not positive.
    """
    if not zoom > 0:
        raise InputError(f"a synthetic shot with a zoom of {zoom:g} was asked for; it must be above 0")
    camera = room_camera(width, height)
    quads = _room(np.random.default_rng(seed))
    depth = float(np.median(1 / _cast(quads, camera, pycolmap.Rigid3d(), 1).inverse_depth))
    path = _camera_path(motion, frames, parallax, depth, seed)
    textures = [_texture(np.random.default_rng([seed, i]), quad, camera.focal_length_x) for i, quad in enumerate(quads)]
    time = np.linspace(0, 1, frames)
    zooms = zoom ** (time**2 * (3 - 2 * time))
    views = [
        (with_focal(camera, camera.focal_length_x * factor), pose) for factor, pose in zip(zooms, path, strict=True)
    ]
    return RenderedShot(
        images=[_render(quads, textures, lens, pose) for lens, pose in views],
        depths=[(1 / _cast(quads, lens, pose, 1).inverse_depth).astype(np.float32) for lens, pose in views],
        camera=camera,
        cam_from_world=path,
        zoom=zooms,
    )


def render_views(
    cam_from_world: Iterable[pycolmap.Rigid3d], width: int, height: int, seed: int = 0
) -> Iterator[NDArray[np.uint8]]:
    """The room of `render_shot` from any cameras in it, as (h, w, 3) BGR, one after the other.

    Args:
        cam_from_world: the cameras; the room has no wall behind that of the identity.
        width, height, seed: see `render_shot`, whose lens it is.
    """
    camera = room_camera(width, height)
    quads = _room(np.random.default_rng(seed))
    textures = [_texture(np.random.default_rng([seed, i]), quad, camera.focal_length_x) for i, quad in enumerate(quads)]
    for pose in cam_from_world:
        yield _render(quads, textures, camera, pose)


def simulate_prior(shot: RenderedShot, error: float = 0.05, seed: int = 0) -> list[NDArray[np.float32]]:
    """Inverse depth as a good network gives it: relative, (h, w) float32 per frame, larger is nearer.

    Every frame has a scale (20 % spread) and a shift (10 to 20 % of the range of inverse depths) of its own.
    The error is smooth over the image; half of its variance stays over the shot, half changes slowly.

    Args:
        shot: gives the true depth.
        error: standard deviation of the error as a fraction of the inverse depth.
        seed: of everything random.
    """
    generator = np.random.default_rng([seed, 2])
    height, width = shot.depths[0].shape
    fixed, changing = (_smooth_field(generator, height, width) for _ in range(2))
    memory = np.exp(-1 / FRAMES_PER_SECOND)
    priors = []
    for depth in shot.depths:
        inverse = np.exp(error * (fixed + changing) / np.sqrt(2)) / depth
        scale = np.exp(0.2 * generator.standard_normal())
        shift = generator.uniform(0.1, 0.2) * np.ptp(np.percentile(inverse, [2, 98]))
        priors.append((scale * (inverse + shift)).astype(np.float32))
        fresh = _smooth_field(generator, height, width)
        changing = memory * changing + np.sqrt(1 - memory**2) * fresh
    return priors


def write_shot(shot: RenderedShot, folder: str | Path) -> None:
    """Write ``shot.mp4``, ``depth/%06d.npy`` (`simulate_prior`), ``camera.json`` and ``groundtruth.txt``.

    The lines of ``groundtruth.txt`` are ``frame tx ty tz qx qy qz qw``, camera-to-world.

    Raises:
        InputError: the folder cannot be written or OpenCV cannot encode the video.
    """
    folder = Path(folder)
    try:
        (folder / "depth").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"folder {folder} cannot be written: {error.strerror}") from error
    for index, prior in enumerate(simulate_prior(shot)):
        np.save(folder / "depth" / f"{index:06d}.npy", prior)
    (folder / "camera.json").write_text(json.dumps(camera_to_json(shot.camera), indent=1) + "\n")
    lines = []
    for index, pose in enumerate(shot.cam_from_world):
        world_from_cam = pose.inverse()
        numbers = [*world_from_cam.translation, *world_from_cam.rotation.quat]
        lines.append(" ".join([str(index), *(f"{number:.9f}" for number in numbers)]) + "\n")
    (folder / "groundtruth.txt").write_text("".join(lines))
    video = cv2.VideoWriter(
        str(folder / "shot.mp4"),
        cv2.VideoWriter.fourcc(*"mp4v"),
        FRAMES_PER_SECOND,
        (shot.camera.width, shot.camera.height),
    )
    if not video.isOpened():
        raise InputError(f"OpenCV cannot encode the video {folder / 'shot.mp4'}")
    for image in shot.images:
        video.write(image)
    video.release()


@dataclass(frozen=True, slots=True, eq=False)
class _Quad:
    """The parallelogram origin + u * edges[0] + v * edges[1], u and v from 0 to 1, and its brightness."""

    origin: Floats
    edges: Floats
    shade: float


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """What the rays of an image hit: row in the list of quads, place on the quad (u, v), 1 / z."""

    quad: NDArray[np.int16]
    uv: NDArray[np.floating]
    inverse_depth: NDArray[np.floating]


def _room(generator: np.random.Generator) -> list[_Quad]:
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
    for i, depth in enumerate(np.linspace(2.8, 6.2, 9)):  # standing on the floor, left and right in turn
        size = generator.uniform([0.4, 0.6, 0.4], [0.8, 1.5, 0.8]) * [depth / 5, 1, depth / 5]
        middle = (-1) ** i * generator.uniform(0.15, 0.6) * depth * np.tan(_FIELD_OF_VIEW / 2)
        quads += _box(generator, np.array([np.clip(middle, -1.7, 1.7), floor - size[1] / 2, depth]), size)
    for depth in np.linspace(3.2, 5.7, 4):  # hanging from the ceiling
        size = generator.uniform([0.3, 0.3, 0.3], [0.7, 0.7, 0.7])
        middle = generator.uniform(-0.8, 0.8) * depth * np.tan(_FIELD_OF_VIEW / 2)
        quads += _box(generator, np.array([np.clip(middle, -1.7, 1.7), ceiling + size[1] / 2, depth]), size)
    return quads


def _box(generator: np.random.Generator, center: Floats, size: Floats) -> list[_Quad]:
    """The six faces of a box that is turned about the vertical by up to 40 degrees."""
    turn = np.radians(generator.uniform(-40, 40))
    x, y, z = pycolmap.Rotation3d(np.array([0, turn, 0])).matrix().T * size[:, None]
    corner = center - (x + y + z) / 2
    faces = [(x, y, z, 0.9), (z, y, x, 0.7), (x, z, y, 1.0)]
    return [
        _Quad(corner + offset, np.array([u, v]), shade)
        for u, v, across, shade in faces
        for offset in (np.zeros(3), across)
    ]


def _cast(quads: list[_Quad], camera: pycolmap.Camera, pose: pycolmap.Rigid3d, oversampling: int) -> _Hits:
    """Meet every pixel's ray with the nearest quad; exact, since u/z, v/z and 1/z are linear in the pixel."""
    dtype = np.float64 if oversampling == 1 else np.float32  # depth is truth, colour is not
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
        seam = 1e-6  # neighbours overlap by this much: no ray slips through a corner of the room
        hit = (w > nearest[2][window]) & (u >= -seam) & (u <= w + seam) & (v >= -seam) & (v <= w + seam)
        hit_quad[window][hit] = i
        for old, new in zip(nearest, (u, v, w), strict=True):
            old[window][hit] = new[hit]
    return _Hits(hit_quad, nearest[:2] / nearest[2], nearest[2])


def _render(
    quads: list[_Quad], textures: list[NDArray[np.uint8]], camera: pycolmap.Camera, pose: pycolmap.Rigid3d
) -> NDArray[np.uint8]:
    """Two by two samples per pixel, averaged."""
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


def _texture(generator: np.random.Generator, quad: _Quad, focal_length: float) -> NDArray[np.uint8]:
    """Bricks, blotches with sharp edges, noise of all sizes; about one texel per pixel of the first image."""
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
    """Noise of zero mean and unit deviation; wavelengths in world units, at least three texels."""
    total = np.zeros((height, width))
    wavelength = coarsest
    while wavelength >= max(finest, 3 * max(length[0] / width, length[1] / height)) or wavelength == coarsest:
        cells = np.ceil(length / wavelength).astype(int) + 2
        grid = generator.standard_normal((cells[1], cells[0]))
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        wavelength /= 2
    return np.asarray((total - total.mean()) / total.std())


def _smooth_field(generator: np.random.Generator, height: int, width: int) -> Floats:
    """(height, width) of zero mean and unit deviation, correlated over about a quarter of the image."""
    coarse = generator.standard_normal((6, 8))
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray((field - field.mean()) / field.std())
