"""Points observed by a camera on a synthetic path, with exact truth.

Every path starts at the identity: the world frame is that of the first camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.support.errors import InputError

Motion = Literal["dolly", "truck", "handheld", "rotation", "static", "arc", "stages"]
Floats = NDArray[np.float64]

FIELD_OF_VIEW = np.radians(54.0)  # horizontal
_PAN, _TILT, _HANDHELD_TURN = np.radians([12.0, 2.0, 0.4])  # amplitudes of the rotations on the paths
_MARGIN = 1.15  # extent of the points over that of the first image


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene:
    """Points and a moving camera.

    Attributes:
        points: (n, 3) world coordinates.
        camera: the lens.
        cam_from_world: the pose of each frame.
    """

    points: Floats
    camera: pycolmap.Camera
    cam_from_world: list[pycolmap.Rigid3d]

    def observe(self, noise_px: float = 0.0, seed: int = 0) -> list[tuple[NDArray[np.int64], Floats]]:
        """The observations of every frame.

        Args:
            noise_px: standard deviation of the Gaussian noise on each coordinate, pixels.
            seed: of the noise.

        Returns:
            Per frame the rows of the points that project into the image, (k,), and their pixels, (k, 2), with centres
            at integers.
        """
        generator = np.random.default_rng(seed)
        observations = []
        for pose in self.cam_from_world:
            xy = np.asarray(self.camera.img_from_cam(pose * self.points)) - PIXEL_CENTER
            size = np.array([self.camera.width, self.camera.height])
            # Points behind the camera have NaN pixels, for which every comparison is False.
            inside = ((xy >= -PIXEL_CENTER) & (xy < size - PIXEL_CENTER)).all(axis=1)
            noisy = xy[inside] + noise_px * generator.standard_normal((int(inside.sum()), 2))
            observations.append((np.flatnonzero(inside), noisy))
        return observations

    def depth(self, frame: int, ids: NDArray[np.int64]) -> Floats:
        """True z-depth (k,), world units, of the points in rows (k,) in a frame."""
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
        """Inverse depth of points as a depth network gives it: ``scale * (1 / z + error) + shift``, (k,).

        Args:
            frame: position in `cam_from_world`.
            ids: (k,) rows of the points.
            scale, shift: the affine of this frame.
            noise: standard deviation of the error, as a fraction of the median inverse depth of these points.
            seed: of the error, which is drawn for each frame.
        """
        inverse = 1 / self.depth(frame, ids)
        sigma = noise * np.median(inverse) if len(inverse) else 0.0
        draw = np.random.default_rng([seed, frame]).standard_normal(len(inverse))
        return scale * (inverse + sigma * draw) + shift


def synthetic_scene(
    motion: Motion = "dolly", frames: int = 30, points: int = 400, parallax: float = 0.03, seed: int = 0
) -> SyntheticScene:
    """Random points between 2 and 8 units in front of a camera of 640x360 pixels.

    Args:
        motion: camera path; "rotation" and "static" do not translate, "stages" stands, pans, and trucks in turn.
        frames: number of frames, at least 2.
        points: number of points; some enter or leave the image.
        parallax: largest distance of a camera from the first one over the median depth of all points in the first
            frame, exact.
        seed: of the points and of the handheld path.

    Raises:
        InputError: an unknown motion, fewer than 2 frames, or a parallax outside 0 to 1.
    """
    camera = room_camera(640, 360)
    generator = np.random.default_rng(seed)
    z = 1 / generator.uniform(1 / 8, 1 / 2, points)
    half = _MARGIN / 2 * np.array([camera.width, camera.height]) / camera.focal_length_x
    xy = generator.uniform(-half, half, (points, 2)) * z[:, None]
    path = camera_path(motion, frames, parallax, float(np.median(z)), seed)
    return SyntheticScene(np.column_stack([xy, z]), camera, path)


def room_camera(width: int, height: int) -> pycolmap.Camera:
    """The lens of all synthetic shots, for images of this size in pixels."""
    focal_length = width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return pycolmap.Camera(
        camera_id=1,
        model="PINHOLE",
        width=width,
        height=height,
        params=[focal_length, focal_length, width / 2, height / 2],
        has_prior_focal_length=True,
    )


def camera_path(motion: str, frames: int, parallax: float, depth: float, seed: int) -> list[pycolmap.Rigid3d]:
    """cam_from_world on a path that starts at the identity.

    Args:
        motion: one of `Motion`.
        frames: number of frames, at least 2.
        parallax: largest distance of a camera from the first one, in units of `depth`.
        depth: world units.
        seed: of the handheld path.

    Raises:
        InputError: an unknown motion, fewer than 2 frames, or a parallax outside 0 to 1.
    """
    if motion not in get_args(Motion):
        raise InputError(f'motion "{motion}" is unknown; one of {", ".join(get_args(Motion))} is expected')
    if frames < 2:
        raise InputError(f"a synthetic shot of {frames} frames was asked for; it needs at least 2")
    if not 0 <= parallax < 1:
        raise InputError(f"a synthetic shot of parallax {parallax:g} was asked for; it must be at least 0 and below 1")
    time = np.linspace(0, 1, frames)
    centers = np.zeros((frames, 3))
    rotations = np.zeros((frames, 3))  # rotation vectors, world_from_cam
    if motion == "dolly":
        centers[:, 2] = time
    elif motion == "truck":
        centers[:, 0] = time
    elif motion == "rotation":
        rotations[:, 1] = _PAN * time
        rotations[:, 0] = _TILT * np.sin(np.pi * time)
    elif motion == "arc":  # about the point on the optical axis at this depth
        angle = 2 * np.arcsin(parallax / 2) * time
        centers = np.column_stack([np.sin(angle), np.zeros(frames), 1 - np.cos(angle)])
        rotations[:, 1] = -angle
    elif motion == "stages":  # a third each: it stands, then pans, then trucks
        rotations[:, 1] = _PAN * np.clip(3 * time - 1, 0, 1)
        centers[:, 0] = np.clip(3 * time - 2, 0, 1)
    elif motion == "handheld":
        generator = np.random.default_rng([seed, 1])
        cycles, phase = generator.uniform(0.5, 2.5, (3, 6)), generator.uniform(0, 2 * np.pi, (3, 6))
        sway = np.sin(2 * np.pi * cycles * time[:, None, None] + phase).sum(axis=1)
        sway -= sway[0]
        centers, rotations = sway[:, :3], _HANDHELD_TURN * sway[:, 3:]
    reach = np.linalg.norm(centers, axis=1).max()
    if reach > 0:
        centers = centers * (parallax * depth / reach)
    return [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), center).inverse()
        for rotation, center in zip(rotations, centers, strict=True)
    ]
