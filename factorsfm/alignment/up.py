"""Up, from all that tells it: an IMU, photographs, edges in the images, the plane of the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.alignment.edges import FRAMES, find_edges, up_from_edges
from factorsfm.alignment.gravity import up_from_photos
from factorsfm.alignment.planes import find_plane
from factorsfm.export.footage import frames_of
from factorsfm.export.shot import Shot
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

_PHOTOS = 24  # that are asked
_GROUND_DEGREES = 1.5  # by which the plane that points lie on is off level: floors slope, and points stand on them
_AGREE = 3.0  # standard deviations within which two sources say the same


@dataclass(frozen=True, slots=True)
class Up:
    """Up in the world of a result.

    Attributes:
        direction: (3,) unit vector; std: standard deviation about its worst axis, degrees.
        sources: "imu", "photos", "edges", "ground": those that agree, the surest first.
    """

    direction: Array
    std: float
    sources: list[str]


def camera_up(result: Reconstruction) -> Array:
    """(3,) the cameras' up, in their mean."""
    down = np.sum(
        [f.cam_from_world.rotation.matrix()[1] for f in result.frames if f.cam_from_world is not None], axis=0
    )
    return np.asarray(-down / np.linalg.norm(down))


def find_up(result: Reconstruction, shot: Shot | None) -> Up | None:
    """Up as far as anything tells it: the surest source, and those that agree with it by their weights.

    Args:
        shot: with the footage in which edges are sought, and which may be photographs that say it; None does without.

    Raises:
        InputError: the footage does not go with the result.
    """
    known: list[tuple[float, str, Array]] = []
    if result.imu is not None:
        known.append((result.imu.up_std, "imu", np.array(result.imu.up)))
    if shot is not None and any(frame.registered for frame in shot.in_footage):
        for name, found in (("photos", _from_photos(shot)), ("edges", _from_edges(shot))):
            if found is not None:
                known.append((found[1], name, found[0]))
    try:
        plane = find_plane(replace(result, alignment=None))  # an earlier one is no evidence
    except InputError:  # too few points for any plane
        plane = None
    if plane is not None and plane.kind == "ground":
        known.append((_GROUND_DEGREES, "ground", plane.axes[2]))
    if not known:
        return None
    known.sort(key=lambda item: item[0])
    least, _, surest = known[0]
    agreeing = [
        (std, name, direction)
        for std, name, direction in known
        if np.degrees(np.arccos(np.clip(direction @ surest, -1, 1))) <= _AGREE * np.hypot(std, least)
    ]
    weights = np.array([1.0 / max(std, 1e-3) ** 2 for std, _, _ in agreeing])
    mean = weights @ np.array([direction for _, _, direction in agreeing])
    return Up(mean / np.linalg.norm(mean), float(weights.sum() ** -0.5), [name for _, name, _ in agreeing])


def _spread(shot: Shot, count: int) -> list[FrameResult]:
    """So many registered frames, all over the footage."""
    registered = [frame for frame in shot.in_footage if frame.registered]
    return [registered[k] for k in np.unique(np.linspace(0, len(registered) - 1, count).astype(int))]


def _from_photos(shot: Shot) -> tuple[Array, float] | None:
    folder = shot.footage
    if folder is None or not folder.is_dir():
        return None
    return up_from_photos(
        (folder / frame.name, shot.reconstruction.camera_of(frame), pose)
        for frame in _spread(shot, _PHOTOS)
        if (pose := frame.cam_from_world) is not None and (folder / frame.name).is_file()
    )


def _from_edges(shot: Shot) -> tuple[Array, float] | None:
    chosen = _spread(shot, FRAMES)
    views = (
        (image.image, shot.reconstruction.camera_of(frame), frame.cam_from_world)
        for frame, image in zip(chosen, frames_of(shot, chosen), strict=True)
        if frame.cam_from_world is not None
    )
    return up_from_edges(find_edges(views), camera_up(shot.reconstruction))
