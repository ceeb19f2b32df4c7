"""A rendered shot in which a rigid thing moves by itself, with exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.synthetic.room import MovingBox, Room
from factorsfm.synthetic.scene import Floats, Motion, camera_path, room_camera
from factorsfm.synthetic.shot import RenderedShot, write_shot

_FROM, _TO = np.array([-0.45, 0.12, 2.3]), np.array([0.4, 0.0, 2.0])  # world units, before all boxes of the room
_BOB = np.array([0.0, 0.05, 0.08])  # amplitude beside the straight way from one to the other, world units
_TURN = np.radians([12.0, 45.0, -8.0])  # rotation vector from the first frame to the last
_FIRST_TURN = np.radians([-15.0, -30.0, 5.0])  # so that the camera sees three faces
_PROPORTIONS = np.array([1.0, 0.8, 0.9])  # of the edges of the box


@dataclass(frozen=True, slots=True, eq=False)
class MovingShot:
    """A rendered room before which a textured box moves and turns.

    Attributes:
        shot: images, depths and camera path; the depths are those of the box where it is seen.
        masks: (h, w) per frame: the pixels that show the box.
        world_from_box: pose of the box in each frame; its origin is its middle.
    """

    shot: RenderedShot
    masks: list[NDArray[np.bool_]]
    world_from_box: list[pycolmap.Rigid3d]


def render_moving(
    motion: Motion = "truck",
    frames: int = 30,
    width: int = 480,
    height: int = 270,
    parallax: float = 0.05,
    size: float = 0.5,
    turn: float = 1.0,
    seed: int = 0,
) -> MovingShot:
    """Render the room of `render_shot` with a box that crosses the image in front of it, and turns by about 47 degrees.

    Args:
        motion, frames, width, height, parallax, seed: as in `render_shot`, without the box; its textures have the
            same seed.
        size: longest edge of the box, world units; 0.5 is about 10 % of the image.
        turn: share of the rotation; 0 moves the box without turning it.

    Raises:
        InputError: as in `render_shot`.
    """
    camera = room_camera(width, height)
    room = Room(seed, camera.focal_length_x)
    depth = float(np.median(room.depth(camera, pycolmap.Rigid3d())))
    path = camera_path(motion, frames, parallax, depth, seed)
    world_from_box = [_box_pose(time, turn) for time in np.linspace(0, 1, frames)]
    box = MovingBox(size * _PROPORTIONS, world_from_box[0], seed + 1, camera.focal_length_x)
    rooms = [room.with_box(box, pose) for pose in world_from_box]
    views = list(zip(rooms, path, strict=True))
    shot = RenderedShot(
        images=[scene.image(camera, pose) for scene, pose in views],
        depths=[scene.depth(camera, pose).astype(np.float32) for scene, pose in views],
        camera=camera,
        cam_from_world=path,
        zoom=np.ones(frames),
    )
    return MovingShot(shot, [scene.box_mask(camera, pose) for scene, pose in views], world_from_box)


def write_moving(moving: MovingShot, folder: str | Path) -> None:
    """Write what `write_shot` writes, and the masks of the box as ``objects/box/%06d.png``.

    Raises:
        InputError: as `write_shot`.
    """
    folder = Path(folder)
    write_shot(moving.shot, folder)
    (folder / "objects" / "box").mkdir(parents=True, exist_ok=True)
    for index, mask in enumerate(moving.masks):
        cv2.imwrite(str(folder / "objects" / "box" / f"{index:06d}.png"), 255 * mask.astype(np.uint8))


def _box_pose(time: float, turn: float) -> pycolmap.Rigid3d:
    """world_from_box; `time` from 0 to 1."""
    eased = time * time * (3.0 - 2.0 * time)
    center: Floats = _FROM + eased * (_TO - _FROM) + np.sin(2 * np.pi * time) * _BOB
    rotation = pycolmap.Rotation3d(turn * eased * _TURN) * pycolmap.Rotation3d(_FIRST_TURN)
    return pycolmap.Rigid3d(rotation, center)
