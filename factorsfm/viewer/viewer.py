"""Shows a stream in the Rerun viewer, live or from a recording (extra ``viewer``)."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.depth_map import DepthKind, DepthMap
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.stream import Stream
from factorsfm.support.context import Closing
from factorsfm.support.errors import InputError
from factorsfm.support.output_files import replaced_file

_JPEG_QUALITY = 80
_PATH_FRAMES = 240  # length of the shown path of live poses
_MAPPED, _UNMAPPED = (80, 220, 100), (240, 170, 40)  # colours of tracks, RGB
_CAMERA = "world/camera"
_IMAGE = f"{_CAMERA}/image"


class Viewer(Closing):
    """The viewer that shows nothing."""

    def watch(self, depth: DepthPrior | None) -> DepthPrior | None:
        """Wrap a prior so that its maps are shown."""
        return depth

    def log(self, frame: Frame, update: FrameUpdate, stream: Stream) -> None:
        """Show a frame and its update."""

    def log_result(self, reconstruction: Reconstruction) -> None:
        """Show the polished path and points, and the shares of prior and parallax in each pose."""

    def close(self) -> None:
        """Write everything that is not written yet."""


def open_viewer(show: bool = False, record: str | Path | None = None) -> Viewer:
    """Open a viewer; without arguments, one that shows nothing.

    Args:
        show: open the window of Rerun.
        record: file (.rrd) to write.

    Raises:
        InputError: Rerun is not installed, its window cannot be opened, or the file cannot be written.
    """
    return RerunViewer(show, record) if show or record is not None else Viewer()


class RerunViewer(Viewer):
    """Shows frames, tracks, path, points and prior depth in Rerun; arguments and errors as in `open_viewer`."""

    def __init__(self, show: bool, record: str | Path | None) -> None:
        try:
            import rerun
        except ImportError as error:
            raise InputError("the viewer needs rerun-sdk: pip install 'factorsfm[viewer]'") from error
        self._rerun: Any = rerun
        self._path: deque[NDArray[np.float64]] = deque(maxlen=_PATH_FRAMES)
        self._shot = 0
        self._recording = rerun.RecordingStream("factorsfm")
        try:
            if show:
                self._recording.spawn(connect=record is None)
            if record is not None:
                file = rerun.FileSink(_writable(Path(record)))
                self._recording.set_sinks(*([rerun.GrpcSink()] if show else []), file)
        except (OSError, RuntimeError) as error:
            raise InputError(f"the viewer cannot be opened: {error}") from error
        self._recording.log("world", rerun.ViewCoordinates.RDF, static=True)

    def watch(self, depth: DepthPrior | None) -> DepthPrior | None:
        return _Watched(depth, self) if depth is not None else None

    def log(self, frame: Frame, update: FrameUpdate, stream: Stream) -> None:
        rr, rec = self._rerun, self._recording
        self._set_time(update.index, frame.timestamp)
        if update.shot != self._shot:
            self._shot = update.shot
            self._path.clear()
            rec.log("world", rr.Clear(recursive=True))
        assert stream.camera is not None
        principal = stream.camera.principal_point_x, stream.camera.principal_point_y
        focal = stream.camera.focal_length_x, stream.camera.focal_length_y
        height, width = frame.image.shape[:2]
        rec.log(_IMAGE, rr.Pinhole(focal_length=focal, principal_point=principal, width=width, height=height))
        rec.log(_IMAGE, rr.Image(frame.image, color_model="BGR").compress(jpeg_quality=_JPEG_QUALITY))
        pixels, mapped = stream.tracks
        colors = np.where(mapped[:, None], _MAPPED, _UNMAPPED).astype(np.uint8)
        rec.log(f"{_IMAGE}/tracks", rr.Points2D(pixels + 0.5, colors=colors, radii=1.5))
        if update.cam_from_world is not None:
            world_from_cam = update.cam_from_world.inverse()
            self._path.append(world_from_cam.translation)
            rec.log(
                _CAMERA,
                rr.Transform3D(
                    translation=world_from_cam.translation,
                    quaternion=rr.Quaternion(xyzw=world_from_cam.rotation.quat),
                ),
            )
            rec.log("world/path", rr.LineStrips3D([list(self._path)]))
        if update.new_points or update.keyframe:
            points, point_colors = stream.points
            rec.log("world/points", rr.Points3D(points, colors=point_colors))
        rec.log("status", rr.TextLog(f"{update.status}: {update.message}"))
        scalars = {"parallax": update.parallax, "tracks": update.tracks, "inliers": update.inliers}
        if update.prior is not None:
            scalars |= {"prior/scale": update.prior.scale, "prior/shift": update.prior.shift}
        self._plot(scalars)

    def log_depth(self, frame: Frame, depth: DepthMap) -> None:
        """Show a map of the prior; bright is near."""
        values = depth.values if depth.kind is DepthKind.INVERSE else 1.0 / depth.values
        finite = np.isfinite(values)
        low, high = np.percentile(values[finite], [1, 99]) if finite.any() else (0.0, 1.0)
        grey = np.where(finite, np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0), 0.0)
        bright = cv2.applyColorMap((255 * grey).astype(np.uint8), cv2.COLORMAP_INFERNO)
        self._set_time(frame.index, frame.timestamp)
        self._recording.log("prior", self._rerun.Image(bright, color_model="BGR").compress(jpeg_quality=_JPEG_QUALITY))

    def log_result(self, reconstruction: Reconstruction) -> None:
        rr = self._rerun
        centers = reconstruction.camera_centers()
        self._set_time(reconstruction.frames[-1].index, reconstruction.frames[-1].timestamp)
        self._recording.log("world/polished/path", rr.LineStrips3D([centers], colors=[[80, 160, 255]]))
        self._recording.log("world/polished/points", rr.Points3D(reconstruction.points, colors=reconstruction.colors))
        for frame in reconstruction.frames:
            if (carried := frame.observability) is not None and np.isfinite(carried.prior_share):
                self._set_time(frame.index, frame.timestamp)
                self._plot({"share/prior": carried.prior_share, "share/parallax": 1.0 - carried.prior_share})

    def close(self) -> None:
        self._recording.flush()
        self._recording.disconnect()

    def _plot(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._recording.log(f"plots/{name}", self._rerun.Scalars(float(value)))

    def _set_time(self, index: int, timestamp: float | None) -> None:
        self._recording.set_time("frame", sequence=index)
        if timestamp is not None:
            self._recording.set_time("time", duration=timestamp)


class _Watched:
    """A prior that shows its maps in a viewer."""

    def __init__(self, depth: DepthPrior, viewer: RerunViewer) -> None:
        self._depth, self._viewer = depth, viewer
        self.kind = depth.kind
        self.name = depth.name

    def __call__(self, frame: Frame) -> DepthMap | None:
        depth_map = self._depth(frame)
        if depth_map is not None:
            self._viewer.log_depth(frame, depth_map)
        return depth_map


def _writable(path: Path) -> Path:
    try:
        replaced_file(path).touch()
    except OSError as error:
        raise InputError(f"recording {path} cannot be written: {error.strerror}") from error
    return path
