"""A reconstruction that is hard on exports, and what its cameras see; nothing here uses the exporting code."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.result.reconstruction import Reconstruction
from tests.exact_result import build

Array = NDArray[np.float64]

PARAMS = [600.0, 1200.0, 290.0, 262.0, 0.06, -0.03, 0.002, -0.001]

# (exported world from OpenCV's) for each up axis, written out: x, y, z of the new world in terms of the old one.
WORLDS = {
    "-y": lambda x, y, z: (x, y, z),
    "y": lambda x, y, z: (x, -y, -z),
    "z": lambda x, y, z: (x, z, -y),
}


def hard_reconstruction(model: str = "OPENCV", **changes: object) -> Reconstruction:
    """Six frames with the indices 10, 12, ..., 20; the one with index 16 is not registered.

    Large rotations about all axes, an off-centre principal point, distortion, and anamorphic pixels, 2:1.
    """
    params = {"OPENCV": PARAMS, "PINHOLE": PARAMS[:4]}[model]
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
    reconstruction = build()
    rng = np.random.default_rng(7)
    for k, frame in enumerate(reconstruction.frames):
        if frame.registered:
            axis_angle = np.array([0.25, -0.5, 0.4]) * k + rng.normal(0, 0.02, 3)
            frame.cam_from_world = pycolmap.Rigid3d(
                pycolmap.Rotation3d(axis_angle), np.array([0.3, -0.2, 0.5]) * k + rng.normal(0, 0.02, 3)
            )
    return replace(reconstruction, camera=camera, **changes)


def numbers(reconstruction: Reconstruction, first_frame: int) -> list[int]:
    return [first_frame + frame.index for frame in reconstruction.registered]


def moved(points: Array, up_axis: str, scale: float) -> Array:
    """(n, 3) points in the exported world."""
    return scale * np.column_stack(WORLDS[up_axis](*points.T))


def true_world_from_film(reconstruction: Reconstruction, up_axis: str, scale: float) -> Array:
    """(k, 4, 4) of cameras that look along -z with y up."""
    found = []
    for frame in reconstruction.registered:
        world_from_cam = frame.cam_from_world.inverse()
        right, down, forward = world_from_cam.rotation.matrix().T
        columns = moved(np.array([right, -down, -forward]), up_axis, 1.0).T
        center = moved(world_from_cam.translation[None], up_axis, scale).T
        found.append(np.vstack([np.hstack([columns, center]), [0, 0, 0, 1]]))
    return np.array(found)


def seen_points(reconstruction: Reconstruction, position: int) -> tuple[Array, Array]:
    """(n, 3) points in front of a registered frame, in the reconstruction's world, and where it sees them.

    (n, 2) pixels from the image's corner: pycolmap's projection with the camera's pinhole part.
    """
    camera = reconstruction.camera
    params = [camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y]
    pinhole = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)
    rng = np.random.default_rng(position)
    depth = rng.uniform(2, 9, 30)
    in_camera = np.column_stack([rng.uniform(-1, 1, (30, 2)) * [0.5, 0.2] * depth[:, None], depth])
    pose = reconstruction.registered[position].cam_from_world
    return pose.inverse() * in_camera, pinhole.img_from_cam(in_camera)


def assert_same_cameras(found: Array, true: Array) -> None:
    """Position within 1e-6 of the scene's size, rotation within 1e-5 rad; (k, 4, 4) camera to world."""
    assert found.shape == true.shape
    size = np.ptp(true[:, :3, 3], axis=0).max()
    assert np.abs(found[:, :3, 3] - true[:, :3, 3]).max() < 1e-6 * size
    between = np.swapaxes(true[:, :3, :3], 1, 2) @ found[:, :3, :3]
    angles = np.linalg.norm(between - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    assert angles.max() < 1e-5


def noise_images(folder: Path, count: int, width: int = 640, height: int = 480, name: str = "shot.{:04d}.png") -> Path:
    """A folder of smooth noise, numbered from 1001 on."""
    folder.mkdir(parents=True)
    for index in range(count):
        coarse = np.random.default_rng(index).integers(0, 256, (8, 10, 3), dtype=np.uint8)
        image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / name.format(1001 + index)), image)
    return folder
