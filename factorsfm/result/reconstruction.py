"""The result of a reconstruction: camera, poses, points with their tracks, prior affines, statuses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap
from factorsfm.control.fit import ControlFit
from factorsfm.polish.observability import CameraObservability
from factorsfm.support.status import FrameStatus, ShotKind


@dataclass(frozen=True, slots=True)
class PriorFit:
    """Scale and shift of one image's depth prior: ``scale / z + shift`` predicts the map's inverse depth.

    Attributes:
        scale, shift: in units of the prior's inverse depth (scale times the world unit).
        scale_std, shift_std: standard deviations from the factor graph.
        sigma: robust standard deviation of the residuals, in the prior's inverse depth.
    """

    scale: float
    shift: float
    scale_std: float
    shift_std: float
    sigma: float


@dataclass(frozen=True, slots=True)
class LensFit:
    """What the shot says of a lens that was not given. Standard deviations are None where a value is no estimate.

    Attributes:
        determined: whether the shot says what the focal length is; otherwise it is the guess, or the mean of the guess
            and what the shot says, each weighed as well as it is known.
        focal_std: standard deviation of the focal length, relative; of a zoom the largest one; None for the guess,
            and for a focal length that was held.
        k1_std, k2_std: of the radial distortion.
        cx_std, cy_std: of the principal point, in focal lengths.
        zoom_std: of the ratio of the longest to the shortest focal length, relative, where a zoom was looked for. The
            course of a zoom is an estimate even where the focal length as a whole is a guess.
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
    """A shutter with which the rows of an image are read one after another.

    Attributes:
        readout: share of the time between two frames that passes from the first row to the last; negative where the
            last one is read first. std: its standard deviation.
        along: "rows" from top to bottom, or "columns" from left to right, as in images that were turned upright.
        recorded: whether the poses are those with which a camera without it would show the points most nearly as the
            recorded images do; otherwise those of the moment when the middle of the image is read.
    """

    readout: float
    std: float
    along: Literal["rows", "columns"]
    recorded: bool


@dataclass(slots=True)
class FrameResult:
    """One frame of the source.

    Attributes:
        index: position in the source, counted from 0 before any range or step is applied.
        name: file name or the zero-padded index.
        timestamp: seconds, where the container has it.
        status, message: what became of it, and the same in words with numbers.
        cam_from_world: pose, or None where the frame is not registered.
        keyframe: whether it is a variable of the incremental graph.
        observations, inliers: tracked points in the frame, and those that the final model explains.
        reprojection_error: median over the inliers (pixels), NaN where not registered.
        prior: fitted scale and shift of the depth prior, None where the frame carries none.
        covariance: (6, 6) of (rotation vector, translation), a perturbation of `world_from_cam` on the right, relative
            to the first registered camera in the scene's unit of length, which is the mean inverse distance of the
            points; with control absolute, in the control's world and unit; None where not registered.
        observability: what carries the pose, None where not registered.
        thumbnail: a small JPEG of the image, None where none is kept.
        camera: the lens of this frame where the frames do not share one, else None; see `Reconstruction.camera_of`.
        focal_std: relative standard deviation of the focal length of this frame, where it is an estimate of its own.
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
    observability: CameraObservability | None = None
    thumbnail: bytes | None = None
    camera: pycolmap.Camera | None = None
    focal_std: float | None = None

    @property
    def registered(self) -> bool:
        """Whether the frame has a pose."""
        return self.cam_from_world is not None


@dataclass(slots=True)
class Reconstruction:
    """Cameras, points and tracks of one shot.

    Attributes:
        camera: the lens (COLMAP convention: pixel centres at 0.5); where frames have lenses of their own, with the
            median of their focal lengths, or of an image set that of most images.
        frames: one entry per frame of the source, in order.
        points: (n, 3) world coordinates.
        colors: (n, 3) uint8 RGB.
        track_ids: (n,) identity of each point's track.
        observation_frame: (m,) position in `frames` of each observation.
        observation_point: (m,) row in `points` of each observation.
        observation_xy: (m, 2) pixels, centres at integers (OpenCV).
        observation_error: (m,) reprojection error, pixels.
        prior_residual: (m,) residual of the depth prior relative to the predicted inverse depth
            ``scale / z``, NaN where the observation carries no prior.
        kind: what the motion allows one to recover.
        parallax: largest camera displacement over the median point depth (paper, section 4).
        point_std: (n,) standard deviation of the inverse distance of each point from the first registered camera,
            relative to it, in the unit of `FrameResult.covariance`; None where it is not known.
        lens: how far the shot determines the lens; None where it was given.
        metric: whether the world unit is the metre (the prior is metric, or control says so).
        control: what control did; None where there was none.
        notes: sentences that a user should read (translation unobservable, focal length guessed, ...).
        seconds: wall time by stage.
        options: resolved options as plain data.
        others: of an image set, the parts of the scene that cannot be joined to this one, largest first.
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
    lens: LensFit | None = None
    shutter: RollingShutter | None = None
    metric: bool = False
    control: ControlFit | None = None
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    others: list[Reconstruction] = field(default_factory=list)

    @property
    def registered(self) -> list[FrameResult]:
        """The frames that have a pose."""
        return [frame for frame in self.frames if frame.registered]

    def camera_of(self, frame: FrameResult) -> pycolmap.Camera:
        """The lens with which a frame was taken."""
        return frame.camera or self.camera

    @property
    def has_own_lenses(self) -> bool:
        """Whether the focal length or more changes from frame to frame."""
        return any(frame.camera is not None for frame in self.frames)

    def camera_centers(self) -> NDArray[np.float64]:
        """(k, 3) centres of the registered cameras, world coordinates."""
        return np.array(
            [f.cam_from_world.inverse().translation for f in self.frames if f.cam_from_world is not None]
        ).reshape(-1, 3)

    def write(self, directory: str | Path) -> None:
        """Write trajectory, COLMAP model, point cloud, summary and report; all of it or nothing.

        Other parts of an image set are written in the same way into `part-002`, `part-003`, ... in it.

        Raises:
            InputError: the directory cannot be written.
        """
        from factorsfm.report.result_folder import write_folder

        write_folder(self, Path(directory))
