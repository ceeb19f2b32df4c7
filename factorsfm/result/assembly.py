"""Assembly of the public result from the polish."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.observations import DISTORTION
from factorsfm.camera.projection import with_focal
from factorsfm.lens.camera_model import with_distortion
from factorsfm.lens.lens import LensEstimate
from factorsfm.lens.rolling_shutter import Shutter
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polish import Polished
from factorsfm.result.notes import notes_on, observability_notes, shutter_note
from factorsfm.result.reconstruction import FrameResult, LensFit, PriorFit, Reconstruction, RollingShutter
from factorsfm.support.parallax import parallax
from factorsfm.support.rotations import camera_centers
from factorsfm.support.similarity import Similarity
from factorsfm.support.status import FrameStatus, ShotKind

Array = NDArray[np.float64]

_INLIER_SIGMAS = 8.0  # reprojection error up to which an observation counts as explained


class SeenFrame(Protocol):
    """What the result needs to know of a frame."""

    @property
    def index(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def timestamp(self) -> float | None: ...


def assemble(
    polished: Polished,
    images: list[MappedImage],
    frames: Sequence[SeenFrame],
    colors: NDArray[np.uint8],
    camera: pycolmap.Camera,
    *,
    lens_given: bool,
    prior_given: bool,
    metric: bool,
    seconds: dict[str, float],
    options: dict[str, Any],
) -> Reconstruction:
    """The public result.

    Args:
        colors: RGB by track id.
        lens_given: whether the camera is known, and no guess.
        prior_given: whether there is a depth prior at all; metric: whether its unit is the metre.
    """
    has_depth = any(image.tracks.depth is not None for image in images)
    state, notes = polished.state, notes_on(polished, has_depth)
    if prior_given and not has_depth:
        notes.append("The depth prior took no part: no frame that needed it has a usable depth map.")
    if polished.lens is None and not lens_given:
        origin = "that of the EXIF data" if camera.has_prior_focal_length else "a guess"
        pixels_long = f"{camera.mean_focal_length():.0f} pixels"
        notes.append(
            f"The focal length is {origin} ({pixels_long}): no camera was given, and the lens was to stay fixed."
        )
    shutter = _rolling_shutter(polished.shutter, recorded=polished.recorded) if polished.shutter is not None else None
    if shutter is not None:
        notes.append(shutter_note(shutter, [frame.timestamp for frame in frames]))
    scale = _metric_scale(polished, images) if metric else None
    if polished.datum is not None:
        scale = polished.datum.scale
    unit = scale or 1.0
    lens = polished.lens
    if lens is not None:
        focal = float(np.median(state.focal))
        camera = with_distortion(camera, focal, lens.lens.shape) if lens.lens.bends else with_focal(camera, focal)
    kept, row_of = _usable_points(polished)
    observations = polished.observations
    keep = row_of[observations.point] >= 0
    frame, point = observations.frame[keep], observations.point[keep]
    positions = np.array(polished.frames)
    xy = np.empty((len(frame), 2))
    for k in np.unique(frame):
        mine = frame == k
        tracks = images[positions[k]].tracks
        xy[mine] = tracks.pixels[np.searchsorted(tracks.ids, polished.tracks[point[mine]])]
    points = state.bearing[kept] / state.inverse_distance[kept, None] * unit
    general = polished.motion.kind is ShotKind.GENERAL
    frame_results = _frame_results(polished, images, frames, camera, unit)
    notes += observability_notes(frame_results)
    prior_residual = np.full(len(observations.point), np.nan)
    if polished.prior is not None:
        p = polished.prior
        order = np.lexsort((p.observations.frame, p.observations.point))
        key = observations.point * (len(positions) + 1) + observations.frame
        at = np.searchsorted(key, (p.observations.point * (len(positions) + 1) + p.observations.frame)[order])
        predicted = p.residual + p.observations.inverse_depth - state.shift[p.observations.image]
        prior_residual[at] = (p.residual / np.maximum(np.abs(predicted), 1e-6))[order]
    result = Reconstruction(
        camera=camera,
        frames=frame_results,
        points=points,
        colors=colors[polished.tracks[kept]],
        track_ids=polished.tracks[kept],
        observation_frame=positions[frame],
        observation_point=row_of[point],
        observation_xy=xy,
        observation_error=polished.errors[keep],
        prior_residual=prior_residual[keep],
        kind=polished.motion.kind,
        parallax=parallax(camera_centers(state.rotation, state.translation), state.inverse_distance),
        point_std=polished.point_std[kept] / state.inverse_distance[kept] if general else None,
        lens=_lens_fit(lens) if lens is not None else None,
        shutter=shutter,
        metric=scale is not None,
        control=polished.control,
        notes=notes,
        seconds=seconds,
        options=options,
    )
    if polished.datum is not None:
        _place(result, polished.datum)
    return result


def _place(result: Reconstruction, datum: Similarity) -> None:
    """Turn and move a result of the right size into the world of its control."""
    world_from_first = pycolmap.Rigid3d(pycolmap.Rotation3d(datum.rotation), datum.translation)
    for frame in result.registered:
        frame.cam_from_world = frame.cam_from_world * world_from_first.inverse()
    result.points = result.points @ datum.rotation.T + datum.translation


def _usable_points(polished: Polished) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Points at a positive, not absurd distance; and the new row of each, -1 where it is left out."""
    inverse = polished.state.inverse_distance
    q = polished.state.camera_points(polished.observations.frame, polished.observations.point)
    nearest = np.full(len(inverse), np.inf)
    np.minimum.at(nearest, polished.observations.point, q[:, 2])
    kept = np.nonzero((inverse > 1e-3) & (nearest > 1e-6))[0]
    row_of = np.full(len(inverse), -1)
    row_of[kept] = np.arange(len(kept))
    return kept, row_of


def _metric_scale(polished: Polished, images: list[MappedImage]) -> float | None:
    """Metres per world unit: a metric prior says ``1 / metres``, the state ``scale / z``."""
    if polished.prior is None:
        return None
    units = [images[polished.frames[r]].tracks.depth.unit for r in polished.prior.images]  # type: ignore[union-attr]
    return 1.0 / float(np.median(polished.state.scale * np.array(units)))


def _frame_results(
    polished: Polished, images: list[MappedImage], frames: Sequence[SeenFrame], camera: pycolmap.Camera, unit: float
) -> list[FrameResult]:
    state, o, lens = polished.state, polished.observations, polished.lens
    threshold = _INLIER_SIGMAS * polished.sigma
    seen = np.bincount(o.frame, minlength=len(polished.frames))
    inliers = np.bincount(o.frame, polished.errors < threshold, len(polished.frames)).astype(int)
    error = [float(np.median(polished.errors[o.frame == k])) for k in range(len(polished.frames))]
    results = []
    row_of = {position: row for row, position in enumerate(polished.frames)}
    prior = _prior_fits(polished, images, unit)
    for position, (frame, image) in enumerate(zip(frames, images, strict=True)):
        result = FrameResult(
            frame.index, frame.name, frame.timestamp, image.status, image.message,
            keyframe=image.keyframe, observations=len(image.tracks.ids),
        )  # fmt: skip
        row = row_of.get(position)
        if row is not None:
            result.cam_from_world = pycolmap.Rigid3d(
                pycolmap.Rotation3d(state.rotation[row]), state.translation[row] * unit
            )
            result.inliers = int(inliers[row])
            result.reprojection_error = error[row]
            result.prior = prior.get(row)
            if len(state.log_focal) > 1:
                result.camera = with_focal(camera, float(state.focal[row]))
                if lens is not None and lens.determined:
                    result.focal_std = float(lens.focal_std[state.group[row]])
            covariance = polished.covariance[row].copy()
            covariance[3:] *= unit
            covariance[:, 3:] *= unit
            result.covariance = covariance
            result.observability = polished.observability[row]
            result.message = f"{result.inliers} of {seen[row]} tracks within {threshold:.2f} pixels"
            if polished.motion.kind is ShotKind.STATIC:
                result.status = FrameStatus.STATIC
                result.message += "; the camera does not move"
        elif position in polished.left_out:
            result.status, result.message = FrameStatus.TOO_FEW_INLIERS, polished.left_out[position]
            result.keyframe = False
        results.append(result)
    return results


def _prior_fits(polished: Polished, images: list[MappedImage], unit: float) -> dict[int, PriorFit]:
    if (p := polished.prior) is None:
        return {}
    fits = {}
    for i, row in enumerate(p.images.tolist()):
        depth = images[polished.frames[row]].tracks.depth
        assert depth is not None
        residual = p.residual[p.observations.image == i]
        fits[row] = PriorFit(
            scale=float(polished.state.scale[i]) * depth.unit * unit,
            shift=float(polished.state.shift[i]) * depth.unit,
            scale_std=float(p.scale_std[i]) * depth.unit * unit,
            shift_std=float(p.shift_std[i]) * depth.unit,
            sigma=1.4826 * float(np.median(np.abs(residual))) * depth.unit,
        )
    return fits


def _rolling_shutter(shutter: Shutter, *, recorded: bool) -> RollingShutter:
    columns, rows = shutter.readout.tolist()
    return RollingShutter(rows or columns, shutter.std, "rows" if rows else "columns", recorded)


def _lens_fit(estimate: LensEstimate) -> LensFit:
    k1, k2, x, y = (float(std) if np.isfinite(std) else None for std in estimate.shape_std[DISTORTION])
    focal_std = float(estimate.focal_std.max()) if estimate.determined or estimate.rough else 0.0
    return LensFit(estimate.determined, focal_std or None, k1, k2, x, y, estimate.zoom_std)
