"""What the motion of a shot lets one recover, and what carries each camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.marginals import Marginals, in_scene, scene_weights, tangent_basis
from factorsfm.options import PolishOptions
from factorsfm.problem import Observations, State
from factorsfm.reconstruction import CameraObservability, FrameResult, ShotKind
from factorsfm.refinement import BundleAdjustment

Array = NDArray[np.float64]

_STATIC_SHARE = 0.004  # largest median displacement of the tracks of a static shot, in focal lengths
# Noise costs one unit per observation (two coordinates, half a unit each). Translation and depths fit some of it; they
# count as observed when they explain at least half as much again as noise. On tripod shots the gain is 0.05 to 0.15,
# on the first ten frames of slow moves 1.5 and more.
LEAST_GAIN = 0.5
# Worth a sentence: the prior gives at least half of the information, or a virtual object may visibly drift.
_NOTED_SHARE = 0.5
_NOTED_SLIDE_PX = 0.5
_MERGED_GAP = 5  # registered frames between two weak stretches that are told as one
_SHORTEST_STRETCH = 3  # frames
_MOST_STRETCHES = 2  # sentences of each sort


@dataclass(frozen=True, slots=True)
class Motion:
    """Kind of a shot's motion, with the numbers that decided.

    Attributes:
        displacement_px: largest median displacement of the tracks against their first appearance.
        gain: decrease of the cost by translation and depth, per observation of the median track.
        rotation_only: the solution without translation.
    """

    kind: ShotKind
    displacement_px: float
    gain: float
    rotation_only: State


def displacement(observations: Observations) -> float:
    """Largest median displacement of the tracks of a frame against their first observation (normalised)."""
    o = observations
    moved = np.linalg.norm(o.xy - o.xy[o.first[o.point]], axis=1)
    order = np.argsort(o.frame, kind="stable")
    parts = np.split(moved[order], np.nonzero(np.diff(o.frame[order]))[0] + 1)
    return max(float(np.median(part)) for part in parts)


def classify_motion(adjustment: BundleAdjustment, observations: Observations, options: PolishOptions) -> Motion:
    """Static, pure rotation, or general motion: does translation explain what rotation alone cannot?

    Args:
        adjustment: converged over poses and points of `observations`.
    """
    state = adjustment.state
    start = observations.first
    rays = np.concatenate([observations.xy[start], np.ones((len(start), 1))], 1)
    rays = np.einsum("nji,nj->ni", state.rotation[observations.frame[start]], rays)
    rotation_only = BundleAdjustment(
        replace(
            state,
            translation=np.zeros_like(state.translation),
            bearing=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        ),
        observations,
        replace(options, iterations=6, tolerance=1e-2),
        sigma=adjustment.sigma,
        free_translation=False,
    )
    rotation_only.solve()
    gain = translation_gain(rotation_only, adjustment)
    moved = displacement(observations)
    kind = ShotKind.ROTATION if moved > _STATIC_SHARE else ShotKind.STATIC
    if gain > LEAST_GAIN:
        kind = ShotKind.GENERAL
    return Motion(kind, moved * float(np.median(state.focal)), gain, rotation_only.state)


def translation_gain(rotation_only: BundleAdjustment, adjustment: BundleAdjustment) -> float:
    """Decrease of the cost by translation and depth, per observation of the median track, of the same observations."""
    difference = rotation_only.observation_costs() - adjustment.observation_costs()
    # Median over the tracks: what moves by itself must not move the camera.
    return float(np.median(adjustment.observations.mean_by_point(difference)))


# --- what carries each camera -----------------------------------------------------------------------------------


def camera_observability(
    adjustment: BundleAdjustment, marginals: Marginals, covariance: Array
) -> list[CameraObservability]:
    """What carries the pose of each camera of a converged problem.

    Args:
        marginals: of the problem; covariance: (c, c) of its camera side, `in_scene_unit`.
    """
    state, o = adjustment.state, adjustment.observations
    share, share_view_axis = _prior_shares(adjustment, marginals)
    angle = np.degrees(triangulation_angles(state, o))
    near = state.inverse_distance[o.point] / state.camera_points(o.frame, o.point)[:, 2]
    cameras = len(state.rotation)
    depth = 1.0 / np.maximum(_median_by_frame(near, o, cameras), 1e-9)
    columns = [share, share_view_axis, _median_by_frame(angle[o.point], o, cameras)]
    columns.append(pixel_slide(pose_blocks(covariance, len(depth)), depth, state.focal))
    return [CameraObservability(*row) for row in np.stack(columns, 1).tolist()]


def _prior_shares(adjustment: BundleAdjustment, marginals: Marginals) -> tuple[Array, Array]:
    """(k,) shares of the prior in the information on all of a camera's position, and along its view axis."""
    state = adjustment.state
    k = len(state.rotation)
    if not pose_blocks(marginals.camera, k)[:, 3:, 3:].any():
        return np.full(k, np.nan), np.full(k, np.nan)
    if adjustment.prior is None:
        return np.zeros(k), np.zeros(k)
    none = np.zeros(0)
    state = replace(state, scale=none, shift=none, field=none)
    alone = BundleAdjustment(
        state, adjustment.observations, adjustment.options,
        sigma=adjustment.sigma, track_errors=adjustment.track_errors,
    ).marginals()  # fmt: skip
    weights = scene_weights(marginals, state)
    both, geometry = (
        np.einsum("kii->ki", pose_blocks(in_scene(m, state, weights), k))[:, 3:] for m in (marginals, alone)
    )
    return _share(both.sum(1), geometry.sum(1)), _share(both[:, 2], geometry[:, 2])


def _share(variance: Array, without: Array) -> Array:
    """Share of the information that is missing without the prior."""
    return np.clip(1.0 - variance / np.maximum(without, 1e-300), 0.0, 1.0)


def pose_blocks(covariance: Array, count: int) -> Array:
    """(count, 6, 6) of the poses in the covariance of a camera side."""
    return np.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])


def triangulation_angles(state: State, observations: Observations) -> Array:
    """(n,) largest angle between two rays of each point (radians), up to 2 % too small."""
    o = observations
    motion = np.einsum("kji,kj->ki", state.rotation, state.translation)
    ray = state.bearing[o.point] + state.inverse_distance[o.point, None] * motion[o.frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    start = o.first
    center = np.add.reduceat(ray, start)
    basis = tangent_basis(center / np.linalg.norm(center, axis=1, keepdims=True))
    flat = np.einsum("mi,mij->mj", ray, basis[o.point])
    widest = np.zeros(len(start))
    for turn in np.arange(8) * np.pi / 8:
        along = flat @ [np.cos(turn), np.sin(turn)]
        widest = np.maximum(widest, np.maximum.reduceat(along, start) - np.minimum.reduceat(along, start))
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * widest, 1.0)))


def pixel_slide(covariance: Array, depth: Array, focal: Array | float) -> Array:
    """Standard deviation, in its worst direction, of the image of a point that rests on the optical axis.

    Args:
        covariance: (k, 6, 6) of the poses; depth: (k,) of the point; focal: pixels, one or (k,).
    """
    by_pose = np.zeros((len(depth), 2, 6))
    by_pose[:, 0, 1], by_pose[:, 1, 0] = -focal, focal
    by_pose[:, 0, 3] = by_pose[:, 1, 4] = -focal / depth
    image = by_pose @ covariance @ by_pose.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(image)[:, -1], 0.0)))


def _median_by_frame(values: Array, observations: Observations, frames: int) -> Array:
    by_frame = (values[observations.frame == k] for k in range(frames))
    return np.array([np.median(mine) if len(mine) else np.nan for mine in by_frame])


# --- in words ---------------------------------------------------------------------------------------------------


def observability_notes(frames: Sequence[FrameResult]) -> list[str]:
    """What a user should know of the prior's share and of the drift: one sentence on the shot, few on stretches.

    Args:
        frames: of the source, in order; only those that are registered count.
    """
    seen = [(f.index, f.observability) for f in frames if f.observability is not None]
    if not seen:
        return []
    index = np.array([i for i, _ in seen])
    share, view_axis, angle, slide = np.array([astuple(o) for _, o in seen]).T
    notes = []
    weak = np.nan_to_num(view_axis) >= _NOTED_SHARE
    if (typical := float(np.median(np.nan_to_num(share)))) >= _NOTED_SHARE:
        notes.append(
            f"{100 * typical:.0f} % of the information on the camera's positions comes from the depth prior: the "
            f"median triangulation angle is {np.median(angle):.2g} degrees, and the tracks alone would leave "
            f"{(1.0 - min(typical, 0.9999)) ** -0.5:.2g} times the error."
        )
        weak &= not weak.all()
    for stretch in _stretches(weak, view_axis):
        notes.append(
            f"{_frames(index[stretch])}: translation along the view axis comes "
            f"{100 * np.median(view_axis[stretch]):.0f} % from the depth prior."
        )
    for stretch in _stretches(slide >= _NOTED_SLIDE_PX, slide):
        notes.append(
            f"{_frames(index[stretch])}: a virtual object at the scene's median depth may drift by "
            f"{slide[stretch].max():.1f} pixels (one standard deviation)."
        )
    return notes


def _stretches(weak: NDArray[np.bool_], values: Array) -> list[slice]:
    """The few runs of weak frames with the largest values, in order; runs with a short gap between are one."""
    rows = np.nonzero(weak)[0]
    runs = np.split(rows, np.nonzero(np.diff(rows) > _MERGED_GAP + 1)[0] + 1)
    stretches = [slice(run[0], run[-1] + 1) for run in runs if len(run) >= min(_SHORTEST_STRETCH, len(weak))]
    stretches.sort(key=lambda stretch: -np.median(values[stretch]))
    return sorted(stretches[:_MOST_STRETCHES], key=lambda stretch: stretch.start)


def _frames(index: NDArray[np.int64]) -> str:
    return f"Frames {index[0]} to {index[-1]}"
