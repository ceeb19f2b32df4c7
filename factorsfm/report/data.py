"""The data for the script of the report: plain values, and arrays as base64 of little-endian numbers."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.alignment.align import survey
from factorsfm.report.charts import charts
from factorsfm.report.geometry import Scene, Tracks, median_prior_residuals, scene, tracks
from factorsfm.report.listed_tracks import ListedTracks, listed_tracks
from factorsfm.report.props import place_props
from factorsfm.report.wording import status_words
from factorsfm.result.moving import Moving
from factorsfm.result.reconstruction import FrameResult, Reconstruction

_MAX_POINTS = 20_000
_MAX_OBSERVATIONS = 150_000
_MAX_MOVING = 50_000
_RESIDUAL_STEPS = 256  # per pixel
_PRIOR_STEPS = 10_000  # per 100 %
_NONE = -(2**15)


def reconstruction_data(reconstruction: Reconstruction) -> dict[str, Any]:
    """All data for the report of a reconstruction."""
    listed = listed_tracks(reconstruction)
    view = scene(reconstruction, _MAX_POINTS, listed.point)
    camera = reconstruction.camera
    unit = "m" if reconstruction.metric else "units"
    return {
        **frames_data(reconstruction.frames, median_prior_residuals(reconstruction), unit),
        "unit": unit,
        "width": camera.width,
        "height": camera.height,
        "sizes": [(lens.width, lens.height) for lens in map(reconstruction.camera_of, reconstruction.frames)],
        "survey": survey(reconstruction),
        "focals": [reconstruction.camera_of(frame).focal_length_x for frame in reconstruction.registered],
        "points": _base64(view.points, "<f4"),
        "colors": _base64(view.colors, "u1"),
        "centers": _base64(view.centers, "<f4"),
        "rotations": _base64(view.rotations, "<f4"),
        "positions": view.positions,
        "tracks": _tracks_data(
            tracks(reconstruction, view, _MAX_OBSERVATIONS, listed.point),
            [reconstruction.camera_of(f) for f in reconstruction.frames],
        ),
        "listed": _listed_data(listed, reconstruction, view),
        "ground": _ground(reconstruction),
        "moving": None if reconstruction.moving is None else _moving_data(reconstruction.moving, reconstruction),
    }


def _ground(reconstruction: Reconstruction) -> str | None:
    """The lines (n, 2, 3) of a grid on the ground of an aligned result, in the axes of the first camera."""
    alignment, first = reconstruction.alignment, next(iter(reconstruction.registered), None)
    if alignment is None or alignment.ground_height is None or first is None or not len(reconstruction.points):
        return None
    assert first.cam_from_world is not None
    ends = place_props(reconstruction).grid[:, [0, -1]]
    return _base64(np.asarray(first.cam_from_world * ends.reshape(-1, 3)), "<f4")


def frames_data(
    frames: Sequence[FrameResult], prior_residual: NDArray[np.float64] | None = None, unit: str = "units"
) -> dict[str, Any]:
    """The data of the frames, also of a shot that failed."""
    if prior_residual is None:
        prior_residual = np.full(len(frames), np.nan)
    return {
        "frame": [frame.index for frame in frames],
        "name": [frame.name for frame in frames],
        "timestamp": [frame.timestamp for frame in frames],
        "status": [status_words(frame.status) for frame in frames],
        "message": [frame.message for frame in frames],
        "registered": [frame.registered for frame in frames],
        "keyframe": [frame.keyframe for frame in frames],
        "thumbnail": [base64.b64encode(frame.thumbnail).decode() if frame.thumbnail else None for frame in frames],
        "charts": [chart.to_data() for chart in charts(frames, prior_residual, unit)],
    }


def _tracks_data(found: Tracks, cameras: Sequence[pycolmap.Camera]) -> dict[str, Any]:
    """Positions as 16-bit fractions of the image; residuals of tracks and prior as 16-bit steps."""
    sizes = np.array([(camera.width, camera.height) for camera in cameras])
    place = (found.xy + 0.5) / sizes[found.position]
    return {
        "start": np.searchsorted(found.position, np.arange(len(cameras) + 1)),
        "point": _base64(found.point, "<u2"),
        "place": _base64(_fractions(place), "<u2"),
        "residual": _base64(_steps(found.residual, _RESIDUAL_STEPS), "<i2"),
        "residual_steps": _RESIDUAL_STEPS,
        "prior": _base64(_steps(found.prior_residual, _PRIOR_STEPS), "<i2"),
        "prior_steps": _PRIOR_STEPS,
    }


def _listed_data(listed: ListedTracks, reconstruction: Reconstruction, view: Scene) -> dict[str, Any]:
    """The listed tracks; `point`: rows in the scene."""
    names = reconstruction.track_names()
    return {
        "number": reconstruction.track_ids[listed.point] + 1,
        "name": [names[row] for row in listed.point.tolist()],
        "point": np.searchsorted(view.rows, listed.point),
        **{name: getattr(listed, name) for name in ("error", "worst", "first", "last", "frames", "supervised")},
    }


def _moving_data(moving: Moving, reconstruction: Reconstruction) -> dict[str, Any]:
    """Tracks that move by themselves, an even choice of them where there are too many, and the stretches."""
    kept = moving.track % max(1, -(-len(moving.frame) // _MAX_MOVING)) == 0
    index = np.array([frame.index for frame in reconstruction.frames])
    position = np.searchsorted(index, moving.frame[kept])
    sizes = np.array([(camera.width, camera.height) for camera in map(reconstruction.camera_of, reconstruction.frames)])
    place = (moving.xy[kept] + 0.5) / sizes[position]
    return {
        "start": np.searchsorted(position, np.arange(len(index) + 1)),
        "track": _base64(moving.track[kept], "<u4"),
        "place": _base64(_fractions(place), "<u2"),
        "stretches": [(stretch.first, stretch.last) for stretch in moving.stretches],
    }


def _fractions(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places between 0 and 1 as 16-bit steps."""
    return np.clip(np.round(65535 * place), 0, 65535)


def _steps(values: NDArray[np.float64], per_unit: int) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), np.clip(np.round(per_unit * values), 1 - 2**15, 2**15 - 1), _NONE)


def _base64(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(values.astype(dtype).tobytes()).decode("ascii")
