"""Assembly of the public result from the polish."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.observations import DISTORTION
from factorsfm.camera.projection import with_focal
from factorsfm.lens.camera_model import with_distortion
from factorsfm.lens.lens import LensEstimate
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.motion.stretches import Stretch
from factorsfm.polish.polished import Polished
from factorsfm.priors.depth_map import DepthKind
from factorsfm.result.frame_results import SourceFrame, frame_results
from factorsfm.result.moving import Moving, moving_in
from factorsfm.result.notes import result_doubts, result_notes
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import LensFit, ObservationNoise, Reconstruction, RollingShutter
from factorsfm.support.parallax import parallax
from factorsfm.support.rotations import camera_centers
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LEAST_INVERSE_DISTANCE, _LEAST_DEPTH = 1e-3, 1e-6  # units of the polish; a point beyond is no point


def assemble(
    polished: Polished,
    images: Sequence[MappedImage],
    frames: Sequence[SourceFrame],
    colors: NDArray[np.uint8],
    camera: pycolmap.Camera,
    *,
    lens_given: bool,
    depth_kind: DepthKind | None,
    seconds: dict[str, float],
    options: dict[str, Any],
    interval: float = 0.0,
) -> Reconstruction:
    """The public result.

    Args:
        images, frames: of the source, in the same order.
        colors: RGB by track id.
        camera: with which the polish began.
        lens_given: whether that camera was given; otherwise it is a guess.
        depth_kind: what the depth prior holds; None without a prior.
        interval: seconds between two frames, 0 if unknown.
    """
    scale = _scale(polished, images, depth_kind)
    unit = scale or 1.0
    kept = _usable_points(polished)
    observations = _observations_of(polished, images, kept)
    state, solved = polished.state, _solved_camera(polished, camera)
    general = polished.motion.kind is ShotKind.GENERAL
    result = Reconstruction(
        camera=solved,
        frames=frame_results(polished, images, frames, solved, unit),
        points=state.bearing[kept] / state.inverse_distance[kept, None] * unit,
        colors=colors[polished.tracks[kept]],
        track_ids=polished.tracks[kept],
        observation_frame=observations.frame,
        observation_point=observations.point,
        observation_xy=observations.xy,
        observation_error=observations.error,
        prior_residual=observations.prior_residual,
        kind=polished.motion.kind,
        stretches=tuple(Stretch(frames[s.first].index, frames[s.last].index, s.kind) for s in polished.stretches),
        parallax=parallax(camera_centers(state.rotation, state.translation), state.inverse_distance),
        point_std=polished.point_std[kept] / state.inverse_distance[kept] if general else None,
        noise=observations.noise,
        lens=_lens_fit(polished.lens),
        shutter=_rolling_shutter(polished),
        rolled=observations.rolled,
        metric=scale is not None,
        control=polished.control,
        seconds=seconds,
        options=options,
    )
    result.moving = _moving(polished, images, frames)
    has_depth = any(image.tracks.depth is not None for image in images)
    guessed = camera if polished.lens is None and not lens_given else None
    moving = result.moving.share_of_image([frame.index for frame in result.registered]) if result.moving else 0.0
    result.doubts += result_doubts(polished, moving)
    result.notes += result_notes(
        polished, result, guessed, depth_given=depth_kind is not None, has_depth=has_depth, interval=interval
    )
    if polished.world_alignment is not None:  # the result has its size already
        result = in_other_world(result, replace(polished.world_alignment, scale=1.0))
    return result


def _moving(polished: Polished, images: Sequence[MappedImage], frames: Sequence[SourceFrame]) -> Moving | None:
    """What moves by itself, in the frames with a pose."""
    return moving_in(
        [images[position].tracks for position in polished.frames],
        [frames[position].index for position in polished.frames],
        np.union1d(polished.tracks, polished.moving),
        polished.moving,
    )


# --- the world ----------------------------------------------------------------------------------------------------


def _scale(polished: Polished, images: Sequence[MappedImage], depth_kind: DepthKind | None) -> float | None:
    """Metres in one unit of the polish, from control or a metric prior; None where neither says so.

    A metric prior says ``1 / metres``, the polish ``scale / z``.
    """
    if polished.world_alignment is not None:
        return polished.world_alignment.scale
    if depth_kind is not DepthKind.METRIC or polished.prior is None:
        return None
    depths = [images[polished.frames[row]].tracks.depth for row in polished.prior.images]
    units = np.array([depth.unit for depth in depths if depth is not None])
    return 1.0 / float(np.median(polished.state.scale * units))


# --- points and observations --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Observations:
    """Observations of the result, see `Reconstruction`."""

    frame: Index
    point: Index
    xy: Array
    error: Array
    prior_residual: Array
    noise: ObservationNoise
    rolled: Array | None


def _usable_points(polished: Polished) -> Index:
    """Rows of the points that are at a positive, not absurd distance in front of all cameras that see them."""
    state, o = polished.state, polished.observations
    nearest = np.full(len(state.inverse_distance), np.inf)
    np.minimum.at(nearest, o.point, state.camera_points(o.frame, o.point)[:, 2])
    return np.flatnonzero((state.inverse_distance > _LEAST_INVERSE_DISTANCE) & (nearest > _LEAST_DEPTH))


def _observations_of(polished: Polished, images: Sequence[MappedImage], points: Index) -> _Observations:
    """What was observed of these points (rows in the polish)."""
    o = polished.observations
    row_of = np.full(len(polished.state.inverse_distance), -1)
    row_of[points] = np.arange(len(points))
    keep = row_of[o.point] >= 0
    kept = o.at(keep)
    positions = np.array(polished.frames)[kept.frame]
    ids = polished.tracks[kept.point]
    xy = np.empty((len(positions), 2))
    for position, mine in zip(polished.frames, kept.rows_by_frame(len(polished.frames)), strict=True):
        tracks = images[position].tracks
        xy[mine] = tracks.pixels[np.searchsorted(tracks.ids, ids[mine])]
    residual, residual_sigma = (relative[keep] for relative in _prior_residuals(polished))
    shift = 0.0 if polished.prior is None else polished.prior.observations.shift_sigma
    noise = ObservationNoise(polished.observation_sigma[keep], polished.track_sigma[points], residual_sigma, shift)
    rolled = None if polished.rolled is None else polished.rolled[keep]
    return _Observations(positions, row_of[kept.point], xy, polished.errors[keep], residual, noise, rolled)


def _prior_residuals(polished: Polished) -> tuple[Array, Array]:
    """(m,) residual of the depth prior relative to the predicted inverse depth, and its standard deviation; NaN where
    there is no prior."""
    o, prior = polished.observations, polished.prior
    residuals, sigmas = np.full((2, len(o.point)), np.nan)
    if prior is None:
        return residuals, sigmas
    p = prior.observations
    # Observations are sorted by point and frame, those with a prior are not.
    order = np.lexsort((p.frame, p.point))
    stride = len(polished.frames) + 1
    at = np.searchsorted(o.point * stride + o.frame, (p.point * stride + p.frame)[order])
    state = polished.state
    depth = state.camera_points(p.frame, p.point)[:, 2] / state.inverse_distance[p.point]
    size = state.scale[p.image] / np.maximum(depth, _LEAST_DEPTH)
    residuals[at], sigmas[at] = (prior.residual / size)[order], (prior.residual_sigma / size)[order]
    return residuals, sigmas


# --- lens and shutter ---------------------------------------------------------------------------------------------


def _solved_camera(polished: Polished, camera: pycolmap.Camera) -> pycolmap.Camera:
    """The lens after the polish; of a zoom with the median of the focal lengths."""
    if polished.lens is None:
        return camera
    focal, lens = float(np.median(polished.state.focal)), polished.lens.lens
    return with_distortion(camera, focal, lens.shape) if lens.bends else with_focal(camera, focal)


def _rolling_shutter(polished: Polished) -> RollingShutter | None:
    if (shutter := polished.shutter) is None:
        return None
    columns, rows = shutter.readout.tolist()
    along: Literal["rows", "columns"] = "rows" if rows else "columns"
    return RollingShutter(rows or columns, shutter.std, along, polished.recorded, polished.shutter_error)


def _lens_fit(estimate: LensEstimate | None) -> LensFit | None:
    if estimate is None:
        return None
    k1, k2, x, y = (float(std) if np.isfinite(std) else None for std in estimate.shape_std[DISTORTION])
    focal_std = float(estimate.focal_std.max()) if estimate.determined or estimate.rough else 0.0
    return LensFit(estimate.determined, focal_std or None, k1, k2, x, y, estimate.zoom_std)
