"""Points on a box that moves before a camera that moves, with exact truth: what the tracks of an object are like."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.objects.scale import PriorOnScene
from factorsfm.objects.solve import SceneCamera
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.synthetic import room_camera
from factorsfm.tracks.image_tracks import ImageTracks

FRAMES, POINTS = 16, 90
FRAME_STEP = 2  # between the indices of frames
SHIFT = 0.3  # of the prior's maps


@dataclass(frozen=True)
class MovingPoints:
    """The truth, and what is seen of it."""

    world_from_object: list[pycolmap.Rigid3d]
    points: NDArray[np.float64]
    images: list[ImageTracks]
    cameras: dict[int, SceneCamera]

    def places(self) -> NDArray[np.float64]:
        """(frames, n, 3) of the points in the world."""
        return np.array([pose * self.points for pose in self.world_from_object])


def moving_points(
    size: float = 0.7,
    noise_px: float = 0.05,
    *,
    prior: bool = True,
    prior_factor: float = 1.0,
    rests: float = 0.0,
    sway: float = 0.0,
    drift: float = 0.0,
    seed: int = 0,
) -> MovingPoints:
    """Tracks of points on three sides of a box at a distance of about 2.3.

    Args:
        size: of the box; noise_px: of the tracks.
        prior_factor: by how much nearer the prior says the object is than it is beside the scene.
        rests: share of the time until the box begins to move, but for a `drift` to the right, units in the whole time.
        sway: amplitude of the camera beside its steady way.
    """
    rng = np.random.default_rng(seed)
    camera = room_camera(480, 270)
    points = rng.uniform(-0.5, 0.5, (POINTS, 3))
    points[np.arange(POINTS), rng.integers(0, 3, POINTS)] = -0.5
    points *= size
    poses, images, cameras = [], [], {}
    for k, elapsed in enumerate(np.linspace(0, 1, FRAMES)):
        time = max(0.0, elapsed - rests) / (1.0 - rests)
        turn = pycolmap.Rotation3d(np.array([0.1, 0.7, -0.1]) * time + [0.3, 0.4, 0.0])
        poses.append(
            pycolmap.Rigid3d(turn, np.array([0.8 * time - 0.4 + drift * elapsed, 0.1 * time**2, 2.4 - 0.3 * time]))
        )
        way = np.array([-0.2 * elapsed, 0.0, 0.0]) + sway * np.sin([9.0 * elapsed, 14.0 * elapsed, 6.0 * elapsed])
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.05, 0.0]) * elapsed), way)
        in_camera = cam_from_world * (poses[-1] * points)
        pixels = camera.img_from_cam(in_camera) - 0.5 + noise_px * rng.standard_normal((POINTS, 2))
        inverse = prior_factor / in_camera[:, 2] * np.exp(0.02 * rng.standard_normal(POINTS)) + SHIFT
        unit = float(np.median(inverse))
        depth = ImageDepth(inverse / unit, np.ones(POINTS), unit) if prior and k % 3 == 0 else None
        images.append(ImageTracks(k, np.arange(POINTS), pixels, camera, depth))
        said = PriorOnScene(1.0, SHIFT, 0.01, 0.005, 0.02, 0.01) if depth is not None else None
        cameras[k] = SceneCamera(FRAME_STEP * k, cam_from_world, 4.0, said)
    return MovingPoints(poses, points, images, cameras)
