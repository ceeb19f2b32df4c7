"""A rendered shot with exact truth: images, depth and poses; and a depth prior with the errors of a network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import camera_to_json
from factorsfm.camera.projection import with_focal
from factorsfm.support.errors import InputError
from factorsfm.synthetic.rolling import read_by_rows
from factorsfm.synthetic.room import Room
from factorsfm.synthetic.scene import Floats, Motion, camera_path, room_camera

FRAMES_PER_SECOND = 24.0


@dataclass(frozen=True, slots=True, eq=False)
class RenderedShot:
    """A rendered room with exact truth.

    Attributes:
        images: (h, w, 3) uint8 BGR per frame.
        depths: (h, w) float32 per frame: exact z-depth at the pixel centres, world units.
        camera: the lens of the first frame.
        cam_from_world: the pose of each frame.
        zoom: (k,) focal length of each frame over that of the first one.
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
    readout: float = 0.0,
) -> RenderedShot:
    """Render a textured room with boxes between 2 and 7 units in front of the camera.

    Args:
        motion: camera path; "rotation" and "static" do not translate, "stages" stands, pans, and trucks in turn.
        frames: number of frames, at least 2.
        width, height: pixels.
        parallax: largest distance of a camera from the first one over the median depth of the first image,
            exact; beyond about 0.3 the camera may run into a box.
        seed: of the room, its textures and the handheld path.
        zoom: focal length of the last frame over that of the first one; it changes smoothly between them.
        readout: that of a rolling shutter, see `read_by_rows`; poses and depths are those of the middle row.

    Raises:
        InputError: an unknown motion, fewer than 2 frames, a parallax outside 0 to 1, or a zoom that is not positive.
    """
    if not zoom > 0:
        raise InputError(f"a synthetic shot with a zoom of {zoom:g} was asked for; it must be above 0")
    camera = room_camera(width, height)
    room = Room(seed, camera.focal_length_x)
    depth = float(np.median(room.depth(camera, pycolmap.Rigid3d())))
    path = camera_path(motion, frames, parallax, depth, seed)
    time = np.linspace(0, 1, frames)
    zooms = zoom ** (time**2 * (3 - 2 * time))
    views = [
        (with_focal(camera, camera.focal_length_x * factor), pose) for factor, pose in zip(zooms, path, strict=True)
    ]
    images = [room.image(lens, pose) for lens, pose in views]
    depths = [room.depth(lens, pose).astype(np.float32) for lens, pose in views]
    if readout:
        images = [read_by_rows(image, depths[k], views[k][0], path, k, readout) for k, image in enumerate(images)]
    return RenderedShot(
        images=images,
        depths=depths,
        camera=camera,
        cam_from_world=path,
        zoom=zooms,
    )


def render_views(
    cam_from_world: Iterable[pycolmap.Rigid3d], width: int, height: int, seed: int = 0
) -> Iterator[NDArray[np.uint8]]:
    """Render the room of `render_shot` with its lens from any poses: (h, w, 3) BGR images, one by one.

    Args:
        cam_from_world: the poses; the room has no wall behind a camera at the identity.
        width, height, seed: as in `render_shot`.
    """
    camera = room_camera(width, height)
    room = Room(seed, camera.focal_length_x)
    for pose in cam_from_world:
        yield room.image(camera, pose)


def simulate_prior(shot: RenderedShot, error: float = 0.05, seed: int = 0) -> list[NDArray[np.float32]]:
    """Relative inverse depth with the errors of a good network, (h, w) float32 per frame; larger is nearer.

    Every frame has its own scale (20 % spread) and shift (10 to 20 % of the range of inverse depths). The error is
    smooth over the image; half of its variance is constant over the shot, the other half changes within a second.

    Args:
        shot: the shot with its true depth.
        error: standard deviation of the error, as a fraction of the inverse depth.
        seed: of scales, shifts and errors.
    """
    generator = np.random.default_rng([seed, 2])
    height, width = shot.depths[0].shape
    fixed, changing = (_smooth_field(generator, height, width) for _ in range(2))
    kept = np.exp(-1 / FRAMES_PER_SECOND)  # correlation of the changing error from frame to frame
    priors = []
    for depth in shot.depths:
        inverse = np.exp(error * (fixed + changing) / np.sqrt(2)) / depth
        scale = np.exp(0.2 * generator.standard_normal())
        shift = generator.uniform(0.1, 0.2) * np.ptp(np.percentile(inverse, [2, 98]))
        priors.append((scale * (inverse + shift)).astype(np.float32))
        changing = kept * changing + np.sqrt(1 - kept**2) * _smooth_field(generator, height, width)
    return priors


def write_shot(shot: RenderedShot, folder: str | Path) -> None:
    """Write ``shot.mp4``, ``depth/%06d.npy`` (`simulate_prior`), ``camera.json`` and ``groundtruth.txt``.

    The lines of ``groundtruth.txt`` are ``frame tx ty tz qx qy qz qw``, world_from_cam.

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


def _smooth_field(generator: np.random.Generator, height: int, width: int) -> Floats:
    """(height, width) random field of mean 0 and standard deviation 1, correlated over about a quarter of the image."""
    coarse = generator.standard_normal((6, 8))
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray((field - field.mean()) / field.std())
