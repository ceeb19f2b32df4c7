"""The result of an object: a rigid thing that moves by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.objects.scale import ScaleSource


@dataclass(frozen=True, slots=True)
class ObjectFrame:
    """An object in one frame.

    Attributes:
        index: of the frame in its source, as `FrameResult.index`.
        world_from_object: pose; its unit of length is that of the world.
        covariance: (6, 6) of (rotation vector, translation), for a perturbation of `world_from_object` on the right:
            what the tracks leave open, relative to the first of the object's frames and with cameras and scale as they
            are. An error of the scale (`ObjectResult.scale_std`) moves the object along the ray from the camera.
    """

    index: int
    world_from_object: pycolmap.Rigid3d
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ObjectResult:
    """A rigid thing that moves by itself, relative to the scene.

    Attributes:
        name: of the object.
        frames: those in which its pose is known, by time.
        points: (n, 3) in the object's own coordinates: the origin is the centroid of the points, the axes are those of
            the world in the first of `frames`.
        colors: (n, 3) uint8 RGB.
        reprojection_error: median over its observations, pixels.
        scale_std: relative standard deviation of the distance from the camera, and with it of the object's size; None
            where nothing gives the scale beside that of the scene: it is at the scene's median depth then.
        scale_from: "rest": from a time at which it rests in the scene; "prior": from the depth prior; None: nothing.
        note: a sentence on where the scale comes from.
    """

    name: str
    frames: tuple[ObjectFrame, ...]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    reprojection_error: float
    scale_std: float | None
    scale_from: ScaleSource | None
    note: str

    @property
    def rotation_std(self) -> float:
        """Standard deviation of the rotation since the first frame, in the worst frame and about the worst axis,
        degrees."""
        turns = np.array([frame.covariance[:3, :3] for frame in self.frames])
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(turns).max())))
