"""The overlay: the footage with its tracks, and a grid and cubes locked into the scene, as a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.export.footage import frames_of
from factorsfm.export.options import ExportOptions
from factorsfm.export.shot import Defaults, Lens, make_shot
from factorsfm.export.writing import complete_file
from factorsfm.frames.targets import spare_footage
from factorsfm.frames.video import count_frames
from factorsfm.report.props import Props, place_props
from factorsfm.report.wording import status_words
from factorsfm.result.image_sources import footage_of
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.progress import Progress

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".avi": "MJPG"}
LAYERS = ("grid", "cubes", "points", "moving")

_SUBPIXEL = 4  # fractional bits of OpenCV's drawing coordinates
_GRID, _EDGE = (255, 200, 90), (30, 30, 30)
_CUBES = ((60, 150, 250), (190, 110, 220), (110, 190, 90))
_GOOD, _POOR, _LOST = np.array([90, 220, 60.0]), np.array([40, 40, 255.0]), (60, 60, 255)
_MOVING = (255, 40, 255)
_POOR_PX = 1.0  # reprojection error of a point that is drawn in red
_FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
_UPRIGHT, _DIAGONAL = np.eye(2), np.array([[0.7, 0.7], [0.7, -0.7]])  # ends of the arms of a cross
_SIDE = np.linspace(0, 1, 9)[:-1, None]  # a side of a face is drawn in parts, since a lens bends it
_MARGIN = 1.3  # times the image's field of view: beyond it lens models go astray


@dataclass(frozen=True, slots=True)
class Projector:
    """From the world into pixels with centres at integers, through the lens with its distortion.

    Attributes:
        limit: (2,) largest |x / z| and |y / z| that are projected; near: smallest z.
    """

    camera: pycolmap.Camera
    limit: Array
    near: float

    @staticmethod
    def of(reconstruction: Reconstruction) -> Projector:
        distance = np.linalg.norm(reconstruction.points - reconstruction.camera_centers()[0], axis=1)
        camera = reconstruction.camera
        return Projector(camera, Projector._limit(camera), 0.02 * float(np.nanmedian(distance)))

    def through(self, camera: pycolmap.Camera) -> Projector:
        """The same with another lens."""
        return self if camera is self.camera else Projector(camera, self._limit(camera), self.near)

    @staticmethod
    def _limit(camera: pycolmap.Camera) -> Array:
        w, h = camera.width, camera.height
        border = np.array([[0, 0], [w / 2, 0], [w, 0], [w, h / 2], [w, h], [w / 2, h], [0, h], [0, h / 2]])
        rays = np.abs(np.asarray(camera.cam_from_img(border)).reshape(-1, 2))
        known = rays[np.isfinite(rays).all(axis=1)]  # a lens model may have no inverse in the corners
        pinhole = np.array([w / camera.focal_length_x, h / camera.focal_length_y]) / 2
        return np.asarray(_MARGIN * np.maximum(known.max(axis=0) if len(known) else pinhole, pinhole))

    def __call__(self, cam_from_world: pycolmap.Rigid3d, points: Array) -> Array:
        """(..., 2) pixels of (..., 3) points, NaN where they are not in or near the view."""
        in_camera = np.asarray(cam_from_world * points.reshape(-1, 3))
        pixels = np.full((len(in_camera), 2), np.nan)
        ahead = in_camera[:, 2] > self.near
        ahead[ahead] = (np.abs(in_camera[ahead, :2]) <= self.limit * in_camera[ahead, 2:]).all(axis=1)
        if ahead.any():
            pixels[ahead] = np.asarray(self.camera.img_from_cam(in_camera[ahead])) - PIXEL_CENTER
        return pixels.reshape(*points.shape[:-1], 2)


def write_overlay(
    reconstruction: Reconstruction,
    path: str | Path,
    source: str | Path | None = None,
    *,
    hide: Sequence[str] = (),
    progress: Progress | None = None,
) -> Props:
    """Write the footage with what is locked into the scene drawn over it, one picture a frame of the result.

    Args:
        path: .mp4, .mov or .avi (JPEG pictures: larger and better). Its pixels are square: squeezed footage is
            stretched. An odd width or height gains a pixel, since the codecs need even ones.
        source: the shot, as `ExportOptions.footage`; None takes the source of the reconstruction.
        hide: of "grid", "cubes", "points", "moving".
        progress: called with the stage, the frames done, and their number.

    Returns:
        What has been placed into the scene.

    Raises:
        InputError: nothing has been written; the path may be that of the footage.
    """
    path = Path(path)
    if path.suffix.lower() not in CODECS:
        raise InputError(f"an overlay is a video ({', '.join(CODECS)}), not {path.name}")
    if unknown := set(hide) - set(LAYERS):
        raise InputError(f"an overlay has no {min(unknown)!r} to hide; it has {', '.join(LAYERS)}")
    if not reconstruction.registered:
        raise InputError("no frame of this shot is solved; there is nothing to draw over it")
    shot = make_shot(reconstruction, ExportOptions(footage=source), Defaults())
    if shot.footage is None:
        raise InputError("the source of this result is not where it was; say where the shot is")
    spare_footage([path], source, *footage_of(reconstruction.options))
    # In its own world, at the size of the footage.
    reconstruction = replace(shot.reconstruction, alignment=reconstruction.alignment)
    props, projector = place_props(reconstruction), Projector.of(reconstruction)
    frames = shot.in_footage
    step = np.median(np.diff([frame.index for frame in frames])) if len(frames) > 1 else 1
    layers = [layer for layer in LAYERS if layer not in hide]
    with complete_file(path) as file:
        shown = _unsqueezed(shot.lens)
        even = shown[0] + shown[0] % 2, shown[1] + shown[1] % 2
        video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()]), shot.fps / step, even)
        if not video.isOpened():
            raise InputError(f"OpenCV cannot write the video {path}")
        try:
            for position, frame in enumerate(frames_of(shot, frames)):
                if progress is not None:
                    progress("overlay", position, len(frames))
                image = draw_overlay(reconstruction, position, frame.image, props, projector, layers)
                image = (
                    image if shown == image.shape[1::-1] else cv2.resize(image, shown, interpolation=cv2.INTER_CUBIC)
                )
                right, below = even[0] - shown[0], even[1] - shown[1]
                video.write(cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE))
        finally:
            video.release()
        if (kept := count_frames(file)) < len(frames):  # OpenCV says nothing of a full disk
            raise OSError(f"only {kept} of {len(frames)} frames are in the file; is the disk full?")
    return props


def _unsqueezed(lens: Lens) -> tuple[int, int]:
    """Width and height of the picture in square pixels: no line or column is lost."""
    aspect = lens.nominal_aspect
    return round(lens.width * max(aspect, 1.0)), round(lens.height * max(1.0 / aspect, 1.0))


def draw_overlay(
    reconstruction: Reconstruction,
    position: int,
    image: Image,
    props: Props,
    projector: Projector,
    layers: Sequence[str] = LAYERS,
) -> Image:
    """One frame with the layers over it.

    Args:
        position: of the frame in the reconstruction.
        image: (h, w, 3) BGR.
    """
    frame = reconstruction.frames[position]
    canvas, projector = image.copy(), projector.through(reconstruction.camera_of(frame))
    pose = frame.cam_from_world
    if pose is not None:
        if "grid" in layers:
            _draw_grid(canvas, projector(pose, props.grid))
        if "cubes" in layers:
            _draw_cubes(canvas, props, pose, projector)
        if "points" in layers:
            mine = reconstruction.observation_frame == position
            _draw_points(canvas, reconstruction.observation_xy[mine], reconstruction.observation_error[mine])
    if (moving := reconstruction.moving) is not None and "moving" in layers:
        _draw_crosses(canvas, moving.xy[moving.frame == frame.index], _MOVING, _DIAGONAL)
        _draw_legend(canvas)
    _label(canvas, frame)
    return canvas


def _draw_grid(canvas: Image, lines: Array) -> None:
    layer = canvas.copy()
    for line in lines:
        for part in _visible(line):
            cv2.polylines(layer, [_fixed(part)], False, _GRID, 1 + canvas.shape[1] // 1200, cv2.LINE_AA, _SUBPIXEL)
    cv2.addWeighted(layer, 0.8, canvas, 0.2, 0, dst=canvas)


def _draw_cubes(canvas: Image, props: Props, pose: pycolmap.Rigid3d, projector: Projector) -> None:
    """Faces from the farthest to the nearest, as glass, with their edges."""
    faces = props.cubes[:, _FACES]  # (n, 6, 4, 3)
    colors = [[0.75 * np.array(color), np.array(color), *(0.9 * np.array(color),) * 4] for color in _CUBES]
    order = np.argsort(-(pose * faces.mean(axis=2).reshape(-1, 3))[:, 2])
    for cube, face in zip(*np.unravel_index(order, faces.shape[:2]), strict=True):
        corners = faces[cube, face]
        outline = (corners[:, None] * (1 - _SIDE) + np.roll(corners, -1, axis=0)[:, None] * _SIDE).reshape(-1, 3)
        pixels = projector(pose, outline)
        if not np.isfinite(pixels).all():
            continue
        layer = canvas.copy()
        cv2.fillPoly(layer, [_fixed(pixels)], colors[cube % len(colors)][face].tolist(), cv2.LINE_AA, _SUBPIXEL)
        cv2.addWeighted(layer, 0.55, canvas, 0.45, 0, dst=canvas)
        cv2.polylines(canvas, [_fixed(pixels)], True, _EDGE, 1 + canvas.shape[1] // 1200, cv2.LINE_AA, _SUBPIXEL)


def _draw_points(canvas: Image, xy: Array, error: Array) -> None:
    """A cross where each point is tracked: green where the solve agrees, red where it misses it by a pixel."""
    share = np.clip(np.nan_to_num(error, nan=_POOR_PX) / _POOR_PX, 0, 1)[:, None]
    for place, color in zip(xy, (_GOOD + share * (_POOR - _GOOD)).tolist(), strict=True):
        _draw_crosses(canvas, place[None], color, _UPRIGHT)


def _draw_crosses(canvas: Image, xy: Array, color: Sequence[float], arms: Array) -> None:
    """A cross at each place (n, 2), of two arms (2, 2) that are given for one of them by its end."""
    size = 2.0 + canvas.shape[1] / 800
    for arm in size * arms:
        lines = _fixed(xy[:, None] + [-arm, arm])
        cv2.polylines(canvas, list(lines), False, color, 1, cv2.LINE_AA, _SUBPIXEL)


def _draw_legend(canvas: Image) -> None:
    """Which crosses are which, in the lower left corner."""
    size = canvas.shape[1] / 1600 + 0.2
    step, left = round(30 * size), 14
    for line, (text, color, arms) in enumerate(
        (("moves by itself", _MOVING, _DIAGONAL), ("tracked in the scene", _GOOD.tolist(), _UPRIGHT))
    ):
        y = canvas.shape[0] - 14 - step * line
        _draw_crosses(canvas, np.array([[left, y - 8 * size]]), color, arms)
        _write(canvas, text, (round(left + 18 * size), y), size, color)


def _label(canvas: Image, frame: FrameResult) -> None:
    size = canvas.shape[1] / 1600 + 0.2
    color = (255, 255, 255) if frame.registered else _LOST
    text = f"{frame.index}" if frame.registered else f"{frame.index}: {status_words(frame.status)}"
    _write(canvas, text, (10, round(12 + 24 * size)), size, color)


def _write(canvas: Image, text: str, at: tuple[int, int], size: float, color: Sequence[float]) -> None:
    """A text with a dark rim, from its lower left corner on."""
    for ink, thickness in (((0, 0, 0), 3), (color, 1)):
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)


def _visible(line: Array) -> list[Array]:
    """The runs of finite points of a line, each of two points at least."""
    finite: NDArray[np.bool_] = np.isfinite(line[:, 0])
    parts = np.split(np.arange(len(line)), np.flatnonzero(np.diff(finite)) + 1)
    return [line[part] for part in parts if finite[part[0]] and len(part) > 1]


def _fixed(points: Array) -> NDArray[np.int32]:
    return np.asarray(np.round(points * 2**_SUBPIXEL), dtype=np.int32)
