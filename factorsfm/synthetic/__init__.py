"""Synthetic shots with exact truth: projected points, and a rendered room.

Takes a camera motion, gives observations or images with poses and depth. May import `camera` and what lies below it.
"""

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
    "RenderedShot",
    "SyntheticScene",
    "read_by_rows",
    "render_shot",
    "render_views",
    "room_camera",
    "simulate_prior",
    "synthetic_scene",
    "write_shot",
]
