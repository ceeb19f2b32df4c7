"""A reconstruction in the conventions of film tools: frame numbers, cameras that look along -z, a lens in millimetres.

The cameras of film tools have x right, y up, and look along -z. Those of a reconstruction have OpenCV axes (x right, y
down, z forward), and without control the first camera is the origin of the world. An export rotates the world so that
the chosen axis points up in the first frame, and scales it. It does not level the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.undistortion import distorts
from factorsfm.export.nulls import Null, moving_nulls, point_nulls
from factorsfm.export.options import ExportOptions
from factorsfm.export.other_footage import Numbering, at_size_of, match_numbers, of_source
from factorsfm.frames.fields import Fields
from factorsfm.result.image_sources import added_images, fields_of
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.supervised import named_points
from factorsfm.support.similarity import Similarity
from factorsfm.support.up_axis import FILM_CAMERA, TURNED_WORLD, UpAxis

_DEFAULT_FPS = 24.0
_MOST_ROUNDING = 0.01  # relative: neighbouring film rates differ by four times as much
_EVEN = 0.2  # of the usual step: containers round times
_FRAME_RATES = (24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 48.0, 50.0, 60000 / 1001, 60.0)


@dataclass(frozen=True, slots=True)
class Defaults:
    """Default values of a format.

    Attributes:
        first_frame: see `ExportOptions`.
        numbered: whether frames have the numbers of their files, where these are a numbered sequence; `first_frame`
            is for all other sources then.
    """

    up_axis: UpAxis = UpAxis.MINUS_Y
    scale: float = 1.0
    first_frame: int = 0
    numbered: bool = True


_NEARLY_SQUARE = 0.05  # relative: the least that cameras have on purpose is that of PAL, 1.067


@dataclass(frozen=True)
class Lens:
    """The pinhole part of the camera, with a film back of a given width.

    Lengths on the film back are in mm. The height of the film back follows from the pixel aspect, so that one
    `focal_length` is valid in both directions.

    Attributes:
        width, height: pixels.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels from the top left corner of the image (not from a pixel's centre).
        sensor_width: mm.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    sensor_width: float

    @property
    def focal_length(self) -> float:
        return self.fx * self.sensor_width / self.width

    @property
    def sensor_height(self) -> float:
        return self.height * self.focal_length / self.fy

    @property
    def pixel_aspect(self) -> float:
        """Width over height of a pixel."""
        return self.fy / self.fx

    @property
    def nominal_aspect(self) -> float:
        """The pixel aspect for formats and pictures; 1 where a calibration has given nearly square pixels."""
        return 1.0 if abs(self.pixel_aspect - 1.0) < _NEARLY_SQUARE else self.pixel_aspect

    @property
    def right(self) -> float:
        """How far the middle of the film back lies to the right of the optical axis, mm."""
        return (0.5 - self.cx / self.width) * self.sensor_width

    @property
    def up(self) -> float:
        """How far the middle of the film back lies above the optical axis, mm."""
        return (self.cy / self.height - 0.5) * self.sensor_height


@dataclass(frozen=True)
class Shot:
    """The input of the writer of a format.

    Attributes:
        reconstruction: rotated and scaled to the exported world.
        fps: frames per second.
        first_frame: number of frame 0 of the source, be there one or not: what is added to the index of a frame.
        numbering: which frame of the footage is which.
        sensor_width: mm.
        world: (3, 3) rotation from the world of the reconstruction to the exported world.
        scale: exported length of one world unit.
        up_axis: axis of the exported world that points up in the first frame.
        footage: the video file or folder of images, or None.
        options: of the user.
    """

    reconstruction: Reconstruction
    fps: float
    first_frame: int
    numbering: Numbering
    sensor_width: float
    world: NDArray[np.float64]
    scale: float
    up_axis: UpAxis
    footage: Path | None
    options: ExportOptions

    @property
    def first(self) -> int:
        """Number of the first frame of the reconstruction, registered or not."""
        return self.first_frame + self.reconstruction.frames[0].index

    @property
    def last(self) -> int:
        return self.first_frame + self.reconstruction.frames[-1].index

    @property
    def footage_start(self) -> int:
        """Number of the first frame of the footage."""
        return self.first_frame + self.numbering.footage_first - self.numbering.shift

    @property
    def are_photographs(self) -> bool:
        """Whether these are images in any order: counted from 0, turned and scaled to the format of their cameras."""
        return bool(self.reconstruction.options.get("unordered"))

    @cached_property
    def in_footage(self) -> list[FrameResult]:
        """The frames that the footage holds: not those of images that were added to the result."""
        added = added_images(self.reconstruction.options)
        return [frame for frame in self.reconstruction.frames if not added or frame.index < added[0].first]

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the registered frames."""
        return [self.first_frame + frame.index for frame in self.reconstruction.registered]

    @property
    def lost(self) -> list[int]:
        """Numbers of the unregistered frames."""
        return [self.first_frame + frame.index for frame in self.reconstruction.frames if not frame.registered]

    @cached_property
    def world_from_opencv(self) -> NDArray[np.float64]:
        """(k, 4, 4) camera to world of the registered frames; camera x right, y down, looking along +z."""
        matrices = np.tile(np.eye(4), (len(self.numbers), 1, 1))
        for matrix, frame in zip(matrices, self.reconstruction.registered, strict=True):
            assert frame.cam_from_world is not None
            matrix[:3] = frame.cam_from_world.inverse().matrix()
        return matrices

    @cached_property
    def world_from_film(self) -> NDArray[np.float64]:
        """(k, 4, 4) camera to world of the registered frames; camera x right, y up, looking along -z."""
        return np.asarray(self.world_from_opencv @ FILM_CAMERA, dtype=np.float64)

    @cached_property
    def nulls(self) -> list[Null]:
        """What moves by itself, and the named points."""
        objects = moving_nulls(self.reconstruction.objects, self.first_frame)
        return objects + point_nulls(named_points(self.reconstruction), self.numbers[0])

    @cached_property
    def lens(self) -> Lens:
        """The lens of the shot."""
        return self._pinhole(self.reconstruction.camera)

    @cached_property
    def lenses(self) -> list[Lens]:
        """The lens of each registered frame."""
        return [self._pinhole(self.reconstruction.camera_of(frame)) for frame in self.reconstruction.registered]

    @property
    def fields(self) -> Fields:
        """How the frames of the footage are read: as those of the result were."""
        return fields_of(self.reconstruction.options)

    @property
    def zooms(self) -> bool:
        """Whether the frames do not share one lens."""
        return self.reconstruction.has_own_lenses

    def _pinhole(self, camera: pycolmap.Camera) -> Lens:
        return Lens(
            width=camera.width,
            height=camera.height,
            fx=float(camera.focal_length_x),
            fy=float(camera.focal_length_y),
            cx=float(camera.principal_point_x),
            cy=float(camera.principal_point_y),
            sensor_width=self.sensor_width,
        )

    @property
    def distorts(self) -> bool:
        """Whether the lens has distortion."""
        return distorts(self.reconstruction.camera)

    @property
    def clipping(self) -> tuple[float, float]:
        """Near and far clipping distance, around the whole scene and within the range of a 24-bit depth buffer."""
        return 5 * self.point_size, 1e5 * self.point_size

    @property
    def point_size(self) -> float:
        """A size at which points are visible and do not overlap: 1/500 of their median distance."""
        points = self.reconstruction.points
        if not len(points) or not self.numbers:
            return 0.01 * self.scale
        centers = self.world_from_opencv[:, :3, 3].mean(axis=0)
        return float(np.median(np.linalg.norm(points - centers, axis=1))) / 500


def linear_colors(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(n, 3) colours from 0 to 1 in linear light."""
    srgb = rgb / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear, dtype=np.float32)


def make_shot(reconstruction: Reconstruction, options: ExportOptions, defaults: Defaults) -> Shot:
    """Fill in the defaults of a format, rotate and scale the world, and scale the lens to the size of given footage.

    Raises:
        InputError: the scaled scene is not finite, or footage is given whose aspect ratio is another one.
    """
    up_axis = UpAxis(options.up_axis) if options.up_axis is not None else defaults.up_axis
    scale = options.scale if options.scale is not None else defaults.scale
    world = TURNED_WORLD[up_axis]
    footage = Path(options.footage) if options.footage is not None else _source(reconstruction)
    if options.footage is not None:
        reconstruction = at_size_of(reconstruction, Path(options.footage))
    numbering = match_numbers(reconstruction, footage)
    return Shot(
        reconstruction=in_other_world(reconstruction, Similarity(scale, world, np.zeros(3))),
        fps=options.fps or _source_fps(reconstruction.frames) or _DEFAULT_FPS,
        first_frame=_first_frame(options, defaults, numbering),
        numbering=numbering,
        sensor_width=options.sensor_width,
        world=world,
        scale=scale,
        up_axis=up_axis,
        footage=footage,
        options=options,
    )


def _first_frame(options: ExportOptions, defaults: Defaults, numbering: Numbering) -> int:
    """What is added to the index of a frame in its source; see `Shot.first_frame`."""
    if options.first_frame is not None:
        return options.first_frame - numbering.source_first
    if defaults.numbered and numbering.timeline is not None:
        return numbering.timeline
    return defaults.first_frame + numbering.shift - numbering.footage_first


def first_frame_of(first_number: int | None, first_frame: int | None, defaults: Defaults) -> int:
    """What an export adds to the index of a frame in its source.

    Args:
        first_number: of a source that is a numbered sequence; first_frame: see `ExportOptions`.
    """
    return _first_frame(ExportOptions(first_frame=first_frame), defaults, of_source(first_number))


def _source_fps(frames: list[FrameResult]) -> float | None:
    """The frame rate from the timestamps, rounded to a standard rate that is very near.

    It is that of the usual steps: pauses, frames that were left out and times that jump back have no part in it.
    """
    timed = [(frame.index, frame.timestamp) for frame in frames if frame.timestamp is not None]
    if len(timed) < 2:
        return None
    gaps, steps = np.diff(np.array(timed, np.float64), axis=0).T
    interval = np.quantile(steps / gaps, 0.5, method="lower")
    if not interval > 0:
        return None
    even = np.abs(steps / gaps / interval - 1.0) < _EVEN
    seconds = float(steps[even].sum())
    fps = float(gaps[even].sum()) / seconds
    # Timestamps are often rounded to milliseconds: at the ends, and around each step that is left out.
    rounding = min(1e-3 * (1 + np.count_nonzero(~even)) / seconds, _MOST_ROUNDING)
    usual = min(_FRAME_RATES, key=lambda rate: abs(rate - fps))
    return usual if math.isclose(usual, fps, rel_tol=max(1e-4, rounding)) else fps


def _source(reconstruction: Reconstruction) -> Path | None:
    source = reconstruction.options.get("source")
    return Path(source) if isinstance(source, str) and Path(source).exists() else None
