"""The result of a reconstruction: camera, poses, points with their tracks, prior affines, statuses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap
from factorsfm.control.fit import ControlFit
from factorsfm.inertial.fit import ImuFit
from factorsfm.motion.stretches import Stretch
from factorsfm.objects.object_result import ObjectResult
from factorsfm.polish.measured import MeasuredShot
from factorsfm.polish.observability import CameraObservability
from factorsfm.result.alignment import Alignment
from factorsfm.result.moving import Moving
from factorsfm.support.status import FrameStatus, ShotKind
from factorsfm.tracks.supervised import SupervisedTracks


@dataclass(frozen=True, slots=True)
class PriorFit:
    """Scale and shift of one image's depth prior: ``scale / z + shift`` predicts the map's inverse depth.

    Attributes:
        scale, shift: in units of the prior's inverse depth (scale times the world unit).
        scale_std, shift_std: standard deviations from the polish.
        sigma: robust standard deviation of the residuals, in the prior's inverse depth.
        smooth: standard deviation of the error that is smooth over the image, which the residuals do not have, in the
            same unit; 0 if unknown.
    """

    scale: float
    shift: float
    scale_std: float
    shift_std: float
    sigma: float
    smooth: float = 0.0


@dataclass(frozen=True, slots=True)
class LensFit:
    """How well an estimated lens is known. A standard deviation is None where the value was not estimated.

    Attributes:
        determined: whether the shot determines the focal length. Otherwise it is the guess, or the mean of guess and
            estimate, weighted by their inverse variances.
        focal_std: relative standard deviation of the focal length; the largest one if it changes. None if the focal
            length is the guess or was held.
        k1_std, k2_std: of the radial distortion.
        cx_std, cy_std: of the principal point, in focal lengths.
        zoom_std: relative standard deviation of the ratio of the longest to the shortest focal length, if a zoom was
            searched. The ratio is an estimate even if the focal length as a whole is a guess.
    """

    determined: bool
    focal_std: float | None
    k1_std: float | None = None
    k2_std: float | None = None
    cx_std: float | None = None
    cy_std: float | None = None
    zoom_std: float | None = None


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """A shutter that reads the rows of an image one after another.

    Attributes:
        readout: time from the first row to the last, as a fraction of the time between two frames; negative if the
            last row is read first. std: its standard deviation.
        along: "rows" from top to bottom, or "columns" from left to right, as in images that were turned upright.
        recorded: True if the poses are those of a global-shutter camera that best reproduces the recorded images;
            False if they are the poses at the moment when the middle of the image is read.
        reprojection_error: median over all observations with the shutter in the model (pixels); NaN if unknown. Poses
            that are `recorded` have a larger one, which says nothing against the tracks.
    """

    readout: float
    std: float
    along: Literal["rows", "columns"]
    recorded: bool
    reprojection_error: float = math.nan


@dataclass(frozen=True, slots=True)
class ObservationNoise:
    """Standard deviations with which the polish weighs what was observed, large for an outlier.

    Attributes:
        pixel: (m,) of each coordinate of an observation, pixels.
        track: (n,) of the error that the track of a point keeps for 16 registered frames, counted from the first of
            them, pixels; 0 where it keeps none.
        prior: (m,) of a value of the depth prior, relative like `Reconstruction.prior_residual`.
        shift: of the shifts of the prior's maps around 0, in units of the median value of a map; 0 without a prior.
    """

    pixel: NDArray[np.float64]
    track: NDArray[np.float64]
    prior: NDArray[np.float64]
    shift: float


@dataclass(slots=True)
class FrameResult:
    """One frame of the source.

    Attributes:
        index: number of the frame in the source, see `Frame.index`.
        name: file name, perhaps with folders before it, or the zero-padded index.
        timestamp: seconds, None if unknown.
        status, message: whether the frame is registered or why not, and the same in words with numbers.
        cam_from_world: pose, None if the frame is not registered.
        keyframe: of a video, whether the mapper made the frame a keyframe: it triangulated points from it and gave its
            pose to the live graph. Of an image set, every registered image is a keyframe.
        observations, inliers: number of tracked points, and of those with a small reprojection error in the result.
        reprojection_error: median over the observations (pixels), NaN if not registered.
        prior: fitted scale and shift of the depth prior, None if the prior is not used in this frame.
        covariance: (6, 6) of (rotation vector, translation), for a perturbation of `world_from_cam` on the right. It is
            relative to the first registered camera, with the scene's scale fixed by the mean inverse distance of the
            points; with control it is absolute, in the control's world and unit. None if unknown.
        relative_covariance: (6, 6) of the pose relative to that of the registered frame before, for a perturbation of
            ``previous_from_this`` on the right, with the scale fixed in the same way. None for the first registered
            frame, and if unknown.
        observability: how well tracks and prior determine the pose, None if unknown.
        thumbnail: a small JPEG of the image, or None.
        camera: the lens of this frame if the frames do not share one, else None; see `Reconstruction.camera_of`.
        focal_std: relative standard deviation of the focal length of this frame, if it has its own estimate.
        repeats: index of the frame whose image a video shows here once more; this one has its pose and all else of it,
            but no observations of its own. None for a new image.
    """

    index: int
    name: str
    timestamp: float | None
    status: FrameStatus
    message: str
    cam_from_world: pycolmap.Rigid3d | None = None
    keyframe: bool = False
    observations: int = 0
    inliers: int = 0
    reprojection_error: float = float("nan")
    prior: PriorFit | None = None
    covariance: NDArray[np.float64] | None = None
    relative_covariance: NDArray[np.float64] | None = None
    observability: CameraObservability | None = None
    thumbnail: bytes | None = None
    camera: pycolmap.Camera | None = None
    focal_std: float | None = None
    repeats: int | None = None

    @property
    def registered(self) -> bool:
        """Whether the frame has a pose."""
        return self.cam_from_world is not None


@dataclass(slots=True)
class Reconstruction:
    """Cameras, points and tracks of one shot.

    Attributes:
        camera: the lens (COLMAP convention: pixel centres at 0.5). If the frames do not share one: for a zoom, the lens
            with the median focal length; for an image set, the lens of most images.
        frames: one entry per frame of the source, in order.
        points: (n, 3) world coordinates.
        colors: (n, 3) uint8 RGB.
        track_ids: (n,) identity of each point's track.
        observation_frame: (m,) position in `frames` of each observation.
        observation_point: (m,) row in `points` of each observation.
        observation_xy: (m, 2) pixels, centres at integers (OpenCV).
        observation_error: (m,) reprojection error, pixels.
        prior_residual: (m,) residual of the depth prior relative to the predicted inverse depth
            ``scale / z``, NaN for an observation without prior.
        kind: what the motion allows one to recover.
        stretches: what the camera does when, in numbers of frames; empty where the images are in no order of time.
        parallax: largest camera displacement over the median point depth (paper, section 4).
        point_std: (n,) relative standard deviation of the inverse distance of each point from the first registered
            camera, with the scale fixed as in `FrameResult.covariance`; None if unknown.
        noise: how the observations are weighed; None if unknown.
        lens: how well the lens is known, None if it was given.
        shutter: the rolling shutter, None if none was found.
        rolled: (m, 2) pixels, how far the shutter displaces each observation beside a camera without one at the poses;
            None if the poses are not fitted to recorded images (`RollingShutter.recorded`), or if unknown.
        metric: whether the world unit is the metre (from a metric prior, or from control).
        control: how well the control is met, or factors that were added; None without either.
        alignment: where up, ground, origin and unit of the world come from, if it was aligned (`align`).
        imu: what an IMU has given, None without one that took part.
        moving: what moves by itself, left out of all else; None where nothing was found. What a mask covers was never
            looked at.
        doubts: why the images leave open what the camera does, in sentences; empty where they do not.
        objects: things that move by themselves and were asked for, as far as they could be solved.
        notes: sentences for the user (translation unobservable, focal length guessed, ...).
        seconds: wall time by stage.
        options: all options as plain data.
        others: reconstructions of other parts of an image set that cannot be joined to this one, largest first.
        measured: of a video, what it was solved from, so that it can be solved again; None if it is not kept.
    """

    camera: pycolmap.Camera
    frames: list[FrameResult]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    track_ids: NDArray[np.int64]
    observation_frame: NDArray[np.int64]
    observation_point: NDArray[np.int64]
    observation_xy: NDArray[np.float64]
    observation_error: NDArray[np.float64]
    prior_residual: NDArray[np.float64]
    kind: ShotKind
    parallax: float
    point_std: NDArray[np.float64] | None = None
    noise: ObservationNoise | None = None
    lens: LensFit | None = None
    shutter: RollingShutter | None = None
    rolled: NDArray[np.float64] | None = None
    metric: bool = False
    control: ControlFit | None = None
    imu: ImuFit | None = None
    alignment: Alignment | None = None
    moving: Moving | None = None
    doubts: list[str] = field(default_factory=list)
    objects: tuple[ObjectResult, ...] = ()
    stretches: tuple[Stretch, ...] = ()
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    others: list[Reconstruction] = field(default_factory=list)
    measured: MeasuredShot | None = None

    @property
    def registered(self) -> list[FrameResult]:
        """The frames that have a pose."""
        return [frame for frame in self.frames if frame.registered]

    def track_names(self) -> list[str]:
        """(n,) of the track of each point: that of the user, or "track_" and its number in COLMAP's model."""
        named = self.measured.supervised if self.measured is not None else SupervisedTracks.none()
        return named.names_of(self.track_ids)

    def camera_of(self, frame: FrameResult) -> pycolmap.Camera:
        """The lens of a frame."""
        return frame.camera or self.camera

    @property
    def has_own_lenses(self) -> bool:
        """Whether the frames do not share one lens."""
        return any(frame.camera is not None for frame in self.frames)

    def camera_centers(self) -> NDArray[np.float64]:
        """(k, 3) centres of the registered cameras, world coordinates."""
        return np.array(
            [f.cam_from_world.inverse().translation for f in self.frames if f.cam_from_world is not None]
        ).reshape(-1, 3)

    def write(self, directory: str | Path) -> None:
        """Write trajectory, COLMAP model, point cloud, summary and report; see `result_folder.write_folder`.

        Raises:
            InputError: the directory cannot be written, or holds something else than an earlier result.
        """
        from factorsfm.report.result_folder import write_folder

        write_folder(self, Path(directory))
