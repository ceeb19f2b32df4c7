"""Points that are picked: where the scene is behind a pixel, from the tracks around it, or the point of a track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.semidefinite import covariance_of, solution

Array = NDArray[np.float64]

_NEIGHBOURS = 8
_REACH = 0.08  # of the image's larger side, within which tracks say how far the scene is
_FEWEST = 3
_CLICK_PX = 1.0  # standard deviation of a picked pixel
_FEW = 1.5  # a spread seen in so few neighbours is too small as often: Student's t with their freedom
_LEAST_PX = 3.0  # between pixels that tell a direction: twice what two clicks may be off
_LEAST_NOISE_PX = 0.1  # of a track that keeps its error


@dataclass(frozen=True, slots=True)
class Pick:
    """A pixel of a frame.

    Attributes:
        frame: name, with or without suffix, or index.
        x, y: pixels, centres at integers (OpenCV).
        track: name of the track that is seen there, whose point is meant; None: what of the scene is behind the pixel.
    """

    frame: str | int
    x: float
    y: float
    track: str | None = None

    @classmethod
    def parse(cls, text: str) -> Pick:
        """From FRAME:X,Y.

        Raises:
            InputError: the text is none.
        """
        frame, _, xy = text.rpartition(":")
        try:
            x, y = (float(value) for value in xy.split(","))
        except ValueError:
            x = y = np.nan
        if not frame or not np.isfinite([x, y]).all():
            raise InputError(
                f'"{text}" is no pixel of a frame, nor a track with a point; FRAME:X,Y is expected, such as '
                "12:640.5,360, or a name"
            )
        return cls(frame, x, y)

    @classmethod
    def of(cls, result: Reconstruction, text: str) -> Pick:
        """From the name of a track, where it is seen nearest to the middle of the image, or from FRAME:X,Y.

        Raises:
            InputError: the text is neither.
        """
        names = result.track_names()
        if text not in names:
            return cls.parse(text)
        posed = np.array([frame.registered for frame in result.frames], bool)
        seen = np.flatnonzero((result.observation_point == names.index(text)) & posed[result.observation_frame])
        middle = np.array([result.camera.width, result.camera.height]) / 2.0
        chosen = seen[np.argmin(np.linalg.norm(result.observation_xy[seen] - middle, axis=1))]
        x, y = result.observation_xy[chosen].tolist()
        return cls(result.frames[result.observation_frame[chosen]].index, x, y, text)

    def __str__(self) -> str:
        return f"{self.frame}:{self.x:g},{self.y:g}" if self.track is None else self.track


@dataclass(frozen=True, slots=True)
class PickedPoint:
    """The scene behind a pixel.

    Attributes:
        position: (3,) world; covariance: (3, 3).
    """

    position: Array
    covariance: Array

    @property
    def std(self) -> float:
        """Along the worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def frame_of(result: Reconstruction, pick: Pick) -> FrameResult:
    """The frame in which a pixel is picked.

    Raises:
        InputError: there is none, it has no pose, or the pixel lies outside of it.
    """
    key = str(pick.frame)
    found = [f for f in result.frames if key in (f.name, PurePath(f.name).stem)]
    found = found or [f for f in result.frames if key == str(f.index)]
    if not found:
        first, last = result.frames[0].index, result.frames[-1].index
        raise InputError(f"{pick}: the result has no frame {key}; it has {first} to {last}")
    if found[0].cam_from_world is None:
        raise InputError(f"{pick}: the frame has no pose; pick in another one")
    camera = result.camera_of(found[0])
    if not (-0.5 <= pick.x <= camera.width - 0.5 and -0.5 <= pick.y <= camera.height - 0.5):
        raise InputError(f"{pick}: the pixel is outside of the frame, which has {camera.width}x{camera.height}")
    return found[0]


def ray(result: Reconstruction, pick: Pick) -> tuple[Array, Array]:
    """Centre (3,) of the camera and direction (3,) to a pixel, 1 long along the view axis; world.

    Raises:
        InputError: as `frame_of`, or the lens sees nothing there.
    """
    frame = frame_of(result, pick)
    assert frame.cam_from_world is not None
    ahead = result.camera_of(frame).cam_from_img(np.array([[pick.x, pick.y]]) + PIXEL_CENTER)
    direction = np.append(np.asarray(ahead).reshape(-1), 1.0)
    if not np.isfinite(direction).all():
        raise InputError(f"{pick}: the lens has no ray through this pixel")
    pose = frame.cam_from_world.inverse()
    return np.asarray(pose.translation), np.asarray(pose.rotation.matrix() @ direction)


def picked_point(result: Reconstruction, pick: Pick) -> PickedPoint:
    """The point of a track, or of the scene behind a pixel, as if the surface were flat among the nearest tracks.

    Inverse depth is linear in the pixels of a plane. What the tracks deviate from that is taken for roughness, which
    the pixel has, too.

    Raises:
        InputError: as `ray`, or there are too few tracks around the pixel.
    """
    center, direction = ray(result, pick)
    if pick.track is not None:
        return _tracked_point(result, pick.track, center)
    frame = frame_of(result, pick)
    assert frame.cam_from_world is not None
    camera = result.camera_of(frame)
    mine = result.observation_frame == result.frames.index(frame)
    rows, away = result.observation_point[mine], result.observation_xy[mine] - [pick.x, pick.y]
    depth = np.asarray(frame.cam_from_world * result.points[rows]).reshape(-1, 3)[:, 2]
    distance = np.linalg.norm(away, axis=1)
    usable = np.flatnonzero((distance < _REACH * max(camera.width, camera.height)) & (depth > 0))
    nearest = usable[np.argsort(distance[usable])[:_NEIGHBOURS]]
    if len(nearest) < _FEWEST:
        raise InputError(
            f"{pick}: {len(nearest)} tracks are near this pixel, {_FEWEST} are needed; pick where there is texture"
        )
    inverse, std = _at_pixel(away[nearest], 1.0 / depth[nearest], distance[nearest])
    noise = _relative_noise(result, rows[nearest], center, _noise_px(result.observation_error))
    relative = float(np.hypot(std / inverse, noise))
    z = 1.0 / inverse
    across = np.eye(3) * (z * _CLICK_PX / camera.mean_focal_length()) ** 2
    along = (z * relative) ** 2 * np.outer(direction, direction)
    return PickedPoint(center + z * direction, across + along)


def _tracked_point(result: Reconstruction, track: str, center: Array) -> PickedPoint:
    """The point of a track, as if its typical error were the same in all frames; `center`: of a camera that sees it."""
    row = result.track_names().index(track)
    away, noise = result.points[row] - center, _noise_px(result.observation_error[result.observation_point == row])
    across = np.eye(3) * (noise / result.camera.mean_focal_length()) ** 2 * (away @ away)
    along = _relative_noise(result, np.array([row]), center, noise) * away
    return PickedPoint(result.points[row], across + np.outer(along, along))


def _noise_px(errors: Array) -> float:
    return max(float(np.nanmedian(errors)), _LEAST_NOISE_PX)


def _at_pixel(away: Array, inverse: Array, distance: Array) -> tuple[float, float]:
    """Inverse depth at the pixel and its standard deviation, from those (n,) of tracks `away` (n, 2) from it."""
    middle = float(np.median(inverse))
    scale = max(float(np.median(distance)), 1.0)
    weight = np.exp(-0.5 * (distance / scale) ** 2)
    design = np.column_stack([np.ones(len(away)), away / scale]) if len(away) > _FEWEST else np.ones((len(away), 1))
    fit = np.zeros(design.shape[1])
    for _ in range(10):  # Cauchy: a neighbour may be on another surface
        # A slope that would change the depth by half within the neighbourhood needs more than a few tracks.
        prior = np.diag([0.0] + [0.01] * (design.shape[1] - 1))
        normal = (design * weight[:, None]).T @ design + prior
        fit = solution(normal, design.T @ (weight * inverse))
        residual = inverse - design @ fit
        spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-4 * middle)
        weight = np.exp(-0.5 * (distance / scale) ** 2) / (1 + (residual / (2 * spread)) ** 2)
    free = max(float(weight.sum()) - design.shape[1], 0.5)
    variance = max(float(weight @ residual**2) / free, spread**2)
    leverage = float(covariance_of(normal)[0, 0])
    value = float(np.clip(fit[0], inverse.min() / 1.5, inverse.max() * 1.5))
    return value, _FEW * float(np.sqrt(variance * (1.0 + leverage)))


def _relative_noise(result: Reconstruction, rows: NDArray[np.int64], center: Array, noise: float) -> float:
    """Relative standard deviation of the distance of some points, as if each track kept one error for good.

    The largest shift in any image when a point moves along its ray tells how well its distance is seen; `noise` in
    pixels.
    """
    wanted = np.flatnonzero(np.isin(result.observation_point, rows))
    shifts: dict[int, float] = dict.fromkeys(rows.tolist(), 0.0)
    for position in np.unique(result.observation_frame[wanted]):
        frame = result.frames[position]
        if frame.cam_from_world is None:
            continue
        seen = result.observation_point[wanted[result.observation_frame[wanted] == position]]
        camera = result.camera_of(frame)
        points = result.points[seen]
        pair = [
            np.asarray(camera.img_from_cam(frame.cam_from_world * moved))
            for moved in (points, points + 1e-4 * (points - center))
        ]
        shift = np.linalg.norm(pair[1] - pair[0], axis=1) / 1e-4
        for point, value in zip(seen.tolist(), shift.tolist(), strict=True):
            shifts[point] = max(shifts[point], value)
    largest = np.array(list(shifts.values()))
    return float(np.median(noise / np.maximum(largest, 1e-9)))


def length_between(a: PickedPoint, b: PickedPoint) -> tuple[float, float]:
    """Distance between two picked points and its standard deviation.

    Raises:
        InputError: the points are one.
    """
    apart = b.position - a.position
    length = float(np.linalg.norm(apart))
    along = apart / max(length, 1e-300)
    std = float(np.sqrt(along @ (a.covariance + b.covariance) @ along))
    if length <= 2 * std:
        raise InputError(f"the picked points are {length:.3g} apart, give or take {std:.2g}; pick points further apart")
    return length, std


def check_direction(result: Reconstruction, start: Pick, end: Pick, there: PickedPoint) -> None:
    """Insist that a pixel tells a direction from another one.

    Args:
        there: the point at the `end`.

    Raises:
        InputError: in the picture of the `start` it is no further away than two clicks may be off.
    """
    frame = frame_of(result, start)
    assert frame.cam_from_world is not None
    seen = result.camera_of(frame).img_from_cam((frame.cam_from_world * there.position)[None])
    apart = float(np.linalg.norm(np.asarray(seen)[0] - PIXEL_CENTER - [start.x, start.y]))
    if apart <= _LEAST_PX:
        raise InputError(f"{end} is {apart:.2g} pixels from {start}, which tells no direction; pick one further away")


def plane_normal(points: Sequence[PickedPoint], eyes: Sequence[Array]) -> tuple[Array, float]:
    """(3,) unit normal of the plane through three points, and its standard deviation about the worst axis, degrees.

    Args:
        eyes: (3,) centres of the cameras in whose pictures they are picked.

    Raises:
        InputError: they are on a line, or nearly, or their plane may pass through a camera.
    """
    a, b, c = (point.position for point in points)
    normal = np.cross(b - a, c - a)
    longest = max((b - a, c - a, c - b), key=lambda side: float(np.linalg.norm(side)))
    length = max(float(np.linalg.norm(longest)), 1e-300)
    breadth = float(np.linalg.norm(normal)) / length
    normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    off, aside = (
        float(np.sqrt(max(along @ point.covariance @ along for point in points)))
        for along in (normal, np.cross(normal, longest / length))
    )
    std = float(np.arctan2(1.5 * off, breadth))
    if breadth <= 2 * max(off, aside):
        raise InputError("the three picked points are on a line, or nearly; pick a third one off the line")
    for eye in eyes:  # pixels on a line are the edge of a plane through the camera, which is no ground
        height, spread = abs(float((eye - a) @ normal)), float(np.hypot(off, std * np.linalg.norm(eye - a)))
        if height <= 2 * spread:
            raise InputError(
                f"the camera is {height:.2g} above the plane of the three picked points, give or take {spread:.2g}, "
                "which tells no ground; pick them further apart, and not on a line of the picture"
            )
    return normal, float(np.degrees(std))
