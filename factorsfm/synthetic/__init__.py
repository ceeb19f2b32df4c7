"""Synthetic shots with exact truth: projected points, a rendered room, a box that moves in it, and an IMU.

Takes a camera motion, gives observations, images with poses and depth, or the samples of an IMU. May import `inertial`
and what lies below it.
"""

from factorsfm.synthetic.imu import SmoothPath, handheld_path, simulate_imu
from factorsfm.synthetic.moving import MovingShot, render_moving, write_moving
from factorsfm.synthetic.rolling import read_by_rows
from factorsfm.synthetic.scene import Motion, SyntheticScene, room_camera, synthetic_scene
from factorsfm.synthetic.shot import (
    RenderedShot,
    render_shot,
    render_views,
    simulate_prior,
    write_shot,
)

__all__ = [
    "Motion",
    "MovingShot",
    "RenderedShot",
    "SmoothPath",
    "SyntheticScene",
    "handheld_path",
    "read_by_rows",
    "render_moving",
    "render_shot",
    "render_views",
    "room_camera",
    "simulate_imu",
    "simulate_prior",
    "synthetic_scene",
    "write_moving",
    "write_shot",
]
