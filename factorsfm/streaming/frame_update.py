"""What a stream says of a frame right after it was pushed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.support.status import FrameStatus


@dataclass(frozen=True, slots=True)
class KeyframePrior:
    """Scale and shift of a keyframe's depth map beside the map, in the prior's unit: ``scale / z + shift``."""

    index: int
    scale: float
    shift: float


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """What is known of a frame right after it was pushed.

    Attributes:
        index: of the frame; status, message: see `FrameResult`.
        cam_from_world: pose now, causal; None where the frame is not registered.
        keyframe: whether the graph has been given it.
        tracks, inliers: tracked points, and those that agree with the pose.
        new_points: points that the map gained since the frame before.
        parallax: largest camera displacement so far over the median depth of the points seen.
        covariance: (6, 6) of the pose (see `FrameResult`), the uncertainty of the map included; None without a pose.
        prior: the newest depth map that the graph has used, None as long as there is none.
        dropped: frames that a live source dropped right before this one.
        shot: number of the shot in an `Episode`.
        focal_length: pixels, as the stream has it now; focal_changed: whether this frame changed it.
        starts_anew: whether the start of the map was given up with this frame, because none of those that followed
            joined it: all poses that were given before are void.
        note: one sentence on what became of the map with this frame, where that is out of the ordinary: a start that
            was given up, a depth prior without which the stream goes on; else empty.
    """

    index: int
    status: FrameStatus
    message: str
    cam_from_world: pycolmap.Rigid3d | None
    keyframe: bool
    tracks: int
    inliers: int
    new_points: int = 0
    parallax: float = 0.0
    covariance: NDArray[np.float64] | None = None
    prior: KeyframePrior | None = None
    dropped: int = 0
    shot: int = 0
    focal_length: float = float("nan")
    focal_changed: bool = False
    starts_anew: bool = False
    note: str = ""
