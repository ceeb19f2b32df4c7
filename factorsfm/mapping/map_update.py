"""What a new keyframe does to the map: its depth, new points, and the graph solved for all that it concerns.

An update works on copies and touches nothing but the graph, so that it can run in another process, beside the
registration of the frames that follow; the mapper takes its result over when it is due.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.noise import typical_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import joint_problem, usual_prior
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.graph.keyframe_graph import FactorGraph, UpdateResult
from factorsfm.mapping.depth_fallback import DepthGuidance
from factorsfm.mapping.incremental import add_points, triangulate_tracks
from factorsfm.mapping.mapped_images import MappedImage, state_of
from factorsfm.mapping.point_map import PointMap
from factorsfm.mapping.prior_check import inconsistency
from factorsfm.mapping.registration import register_image
from factorsfm.mapping.starts import lift
from factorsfm.motion.burn_ins import contradicts, resting
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import MapperOptions, PolishOptions
from factorsfm.tracks.image_tracks import seen_by, shared_tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FREE_KEYFRAMES = 20  # that an update solves for; those before are constant
_HELD_KEYFRAMES = 8  # constant ones that take part, with what they saw
_LEAST_SHARED = 30  # landmarks by which a constant keyframe takes part
_GROSS = 4.0  # times the threshold of an inlier: a young map is wrong, too, and long tracks are precious
YOUNG_KEYFRAMES = 6  # up to which a map is easily bent: by burn-ins, then it begins again, or by what is no prior
_YOUNG_ITERATIONS = 20  # divided by the number of keyframes
_TRIAL_ITERATIONS = 5  # that tell whether what rests is at odds with the others
_SOLVER = replace(PolishOptions(), tolerance=1e-3)
_LARGEST_SIGMA_PX = 3.0
_COVARIANCE_INFLATION = 20.0  # the errors of neighbouring tracks are correlated: so many tracks count as one
_LENS_KEYFRAMES = 6  # from which an unknown focal length is estimated
_LENS_ITERATIONS = 6
_LENS_STD = 0.01  # relative, with which an estimate is better than a guess; a young map can be wrong as a whole
_LENS_SIGMA_PX = 0.3  # standard deviation of the errors above which what they say of the lens is chance
_LARGEST_LENS_STEP = 0.5  # of the logarithm of the focal length
_FARTHEST = 1e-6  # smallest inverse distance of a point


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Result of an update.

    Attributes:
        position: of the new keyframe; depth: its prior.
        committed, reason: whether the map may take it over, and why not.
        ids, points: moved and new points; removed: points that no longer hold.
        poses, affines, covariances: of the keyframes that moved, by position.
        focal: a better focal length (pixels), None where it stays as it is.
        burn_ins: tracks of what is laid over the images.
        mirrored: see `UpdateResult`.
        no_prior: whether the keyframes show that the depth prior is none; `reason` says why.
    """

    position: int
    depth: ImageDepth | None
    committed: bool
    reason: str
    ids: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    removed: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    poses: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    affines: dict[int, tuple[float, float]] = field(default_factory=dict)
    covariances: dict[int, Array] = field(default_factory=dict)
    focal: float | None = None
    burn_ins: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    mirrored: bool = False
    no_prior: bool = False


@dataclass(frozen=True, slots=True)
class MapCopy:
    """What an update starts from: copies that nobody else changes.

    Attributes:
        keyframes: in order of time, the new one last.
        focal: pixels; refine_focal: whether it is a guess.
    """

    keyframes: list[MappedImage]
    points: PointMap
    options: MapperOptions
    focal: float
    refine_focal: bool = False

    @property
    def newest(self) -> MappedImage:
        """The new keyframe."""
        return self.keyframes[-1]

    def read_depth(self, read: Callable[[], ImageDepth | None]) -> None:
        """Give the new keyframe its prior, unless it has one."""
        if self.newest.tracks.depth is None:
            self.newest.tracks = replace(self.newest.tracks, depth=read())

    def without_prior(self) -> MapCopy:
        """The same as if there were no prior."""
        bare = [replace(image, tracks=replace(image.tracks, depth=None)) for image in self.keyframes]
        return replace(self, keyframes=bare)

    def needed(self) -> MapCopy:
        """As much of it as makes a difference to an update, which does not grow with the length of the shot."""
        before, free = _taking_part(self.keyframes)
        keyframes = before + free
        points = self.points.part(np.concatenate([image.tracks.ids for image in keyframes]))
        return replace(self, keyframes=keyframes, points=points)


def update_map(copy: MapCopy, graph: FactorGraph) -> MapUpdate:
    """New landmarks, and what the graph makes of all keyframes around the new one."""
    o, newest = copy.options, copy.newest
    position, depth = newest.tracks.position, newest.tracks.depth
    if o.graph_depth and len(copy.keyframes) <= YOUNG_KEYFRAMES and (reason := inconsistency(copy.keyframes)):
        return MapUpdate(position, depth, False, reason, no_prior=True)
    guidance = DepthGuidance(o, copy.points)
    guidance.fit(newest)
    affine = {position: newest.affine} if newest.affine is not None else {}
    if len(copy.keyframes) == 1:
        return MapUpdate(position, depth, True, "the first keyframe", affines=affine)
    window, held = _window(copy.keyframes)
    _add_landmarks(copy, window, guidance)
    ids = _landmarks(window, copy.points)
    if (seen := int(np.isin(newest.tracks.ids, ids).sum())) < o.min_inliers:
        return MapUpdate(position, depth, False, f"{seen} of {o.min_inliers} needed landmarks in the keyframe")
    # A young map has the shape that the prior guessed, and far to go; it is also cheap.
    iterations = max(o.graph_iterations, _YOUNG_ITERATIONS // len(copy.keyframes))
    adjustment, guided, result = _solved(copy, graph, window, held, ids, iterations)
    burn_ins = removed = _burn_ins(copy, window, held, ids, adjustment)
    if len(burn_ins):
        kept = _lifted_anew(copy, window, np.setdiff1d(ids, burn_ins))
        removed, ids = np.setdiff1d(ids, kept), kept
        adjustment, guided, result = _solved(copy, graph, window, held, ids, _YOUNG_ITERATIONS)
    if not result.committed:
        return MapUpdate(position, depth, False, result.reason, mirrored=result.mirrored)
    focal = _better_focal(adjustment, held) if copy.refine_focal and len(copy.keyframes) >= _LENS_KEYFRAMES else None
    update = _judged(copy, adjustment, window, held, ids, guided, result, focal)
    return replace(update, removed=np.union1d(update.removed, removed), burn_ins=burn_ins) if len(burn_ins) else update


def _solved(
    copy: MapCopy,
    graph: FactorGraph,
    window: list[MappedImage],
    held: NDArray[np.bool_],
    ids: Index,
    iterations: int,
) -> tuple[BundleAdjustment, list[int], UpdateResult]:
    """The window's problem as the graph solves it, the positions of its keyframes with a prior, and the outcome."""
    state = state_of(window, copy.points.at(ids), copy.focal)
    adjustment, rows = _problem(copy, window, held, ids, state, gather([i.tracks for i in window], ids))
    positions = [image.tracks.position for image in window]
    guided = [positions[row] for row in rows]
    return adjustment, guided, graph.update(adjustment, positions, guided, iterations)


def _burn_ins(
    copy: MapCopy, window: list[MappedImage], held: NDArray[np.bool_], ids: Index, solved: BundleAdjustment
) -> Index:
    """Tracks that rest in the image and contradict the others, when both go on from a solution with all of them."""
    state, observations = solved.state, solved.observations
    rests = resting(observations, copy.focal)
    if not rests.any():
        return np.zeros(0, np.int64)
    others = np.nonzero(~rests)[0]
    together, _ = _problem(copy, window, held, ids, state, observations)
    alone, _ = _problem(copy, window, held, ids[others], state.of(others), observations.of(others))
    for adjustment in (together, alone):
        adjustment.solve(_TRIAL_ITERATIONS)
    return ids[rests] if contradicts(together, alone, ~rests) else np.zeros(0, np.int64)


def _lifted_anew(copy: MapCopy, window: list[MappedImage], ids: Index) -> Index:
    """Bring a young map back to the shape that the prior guessed, and its keyframes to their place on it.

    Returns:
        Those of its points that are left; all, as they are, where the map is not young or has not begun like that.
    """
    first, o = window[0].tracks, copy.options
    if len(copy.keyframes) > YOUNG_KEYFRAMES or first.depth is None:
        return ids
    points, valid = lift(first.xy, first.depth)
    good = valid & np.isin(first.ids, ids)
    seen = [np.isin(first.ids, image.tracks.ids) & good for image in window[1:]]
    if min(map(np.count_nonzero, seen)) < o.min_inliers:
        return ids
    for image, mine in zip(window[1:], seen, strict=True):
        xy = image.tracks.xy[np.isin(image.tracks.ids, first.ids[mine])]
        found = register_image(
            points[mine], xy, *image.pose, focal=copy.focal, sigma=o.pixel_sigma, inlier_px=o.inlier_px
        )
        image.rotation, image.translation = found.rotation, found.translation
    copy.points.set(first.ids[good], points[good])
    return first.ids[good]


def _better_focal(adjustment: BundleAdjustment, held: NDArray[np.bool_]) -> float | None:
    """Solve for the focal length, too; None where the map does not determine it yet, or fits no focal length."""
    if adjustment.sigma > _LENS_SIGMA_PX:
        return None
    free = BundleAdjustment(
        adjustment.state,
        adjustment.observations,
        _SOLVER,
        ErrorModel(adjustment.sigma),
        prior=adjustment.prior,
        free=Free(focal=True, held=held),
    )
    state = free.solve(_LENS_ITERATIONS)
    focal = free.columns.log_focal
    variance = _COVARIANCE_INFLATION * float(free.marginals().camera[focal, focal].item())
    if variance > _LENS_STD**2 or abs(state.log_focal - adjustment.state.log_focal)[0] > _LARGEST_LENS_STEP:
        return None
    adjustment.state = state
    return float(np.exp(state.log_focal[0]))


def _taking_part(keyframes: list[MappedImage]) -> tuple[list[MappedImage], list[MappedImage]]:
    """Those before the newest ones that share most with the last, and the newest ones, in order of time."""
    free = keyframes[-_FREE_KEYFRAMES:]
    before = keyframes[: -len(free)]
    shared = np.array([shared_tracks(image.tracks, keyframes[-1].tracks) for image in before], np.int64)
    chosen = np.sort(np.argsort(-shared, kind="stable")[:_HELD_KEYFRAMES])
    return [before[k] for k in chosen], free


def _window(keyframes: list[MappedImage]) -> tuple[list[MappedImage], NDArray[np.bool_]]:
    """The keyframes that take part, in order of time, and which of them are constant."""
    before, free = _taking_part(keyframes)
    window = [image for image in before if shared_tracks(image.tracks, free[-1].tracks) >= _LEAST_SHARED] + free
    held = np.arange(len(window)) < len(window) - len(free)
    # Two constant cameras keep place and size; at the start the first one is the world.
    held[: 2 if before else 1] = True
    return window, held


def _landmarks(window: Sequence[MappedImage], points: PointMap) -> Index:
    """Mapped tracks that two keyframes of the window see."""
    ids = seen_by([image.tracks for image in window], 2)
    return ids[points.contains(ids)]


def _add_landmarks(copy: MapCopy, window: list[MappedImage], guidance: DepthGuidance) -> None:
    """Tracks of the new keyframe that become landmarks: well spread, triangulated from the keyframes that see them."""
    o, newest = copy.options, window[-1]
    known = copy.points.contains(newest.tracks.ids)
    seen = np.concatenate([image.tracks.ids for image in window[:-1]])
    candidates = ~known & np.isin(newest.tracks.ids, seen)
    room = o.landmarks - int(known.sum())
    if room < o.landmarks // 10 or not candidates.any():
        return
    chosen = _spread(newest.tracks.xy, known, np.nonzero(candidates)[0], room)
    _add_points(copy.points, window, newest, np.sort(newest.tracks.ids[chosen]), guidance, copy.focal)


def add_tracks(
    points: PointMap, images: Sequence[MappedImage], near: MappedImage, ids: Index, options: MapperOptions, focal: float
) -> int:
    """Points for tracks that registered images see, keyframes or not, until the graph knows better; their number.

    Args:
        points: the map to which they are added.
        images: registered; near: one of them; ids: those of its tracks that are wanted.
        focal: pixels.
    """
    ids = np.intersect1d(ids, seen_by([image.tracks for image in images], 2))
    ids = ids[~points.contains(ids)]
    return _add_points(points, images, near, ids, DepthGuidance(options, points), focal) if len(ids) else 0


def _add_points(
    points: PointMap,
    images: Sequence[MappedImage],
    near: MappedImage,
    ids: Index,
    guidance: DepthGuidance,
    focal: float,
) -> int:
    """Triangulate tracks of `near` (ascending) from all images, and add what they agree on to the map."""
    found = triangulate_tracks(
        images, ids, guidance,
        focal=focal, inlier_px=guidance.options.inlier_px, fallback=guidance.fallback(near, ids),
    )  # fmt: skip
    return add_points(points, ids, found, (found.inliers >= 2) & (found.inverse_distance > _FARTHEST))


def _problem(
    copy: MapCopy,
    window: list[MappedImage],
    held: NDArray[np.bool_],
    ids: Index,
    state: State,
    observations: Observations,
) -> tuple[BundleAdjustment, list[int]]:
    """The window's problem at the noise that its residuals show, and the rows of its frames with a prior."""
    unit = BundleAdjustment(state, observations, _SOLVER, ErrorModel(1.0), free=Free(held=held))
    typical = typical_sigma(unit.reprojection_errors())
    sigma = min(max(copy.options.pixel_sigma, typical), _LARGEST_SIGMA_PX)
    tracks = [image.tracks for image in window]
    affines = [image.affine for image in window]
    weighed = usual_prior(state, observations, ids, tracks, affines) if copy.options.graph_depth else None
    if weighed is None:
        return BundleAdjustment(state, observations, _SOLVER, ErrorModel(sigma), free=Free(held=held)), []
    adjustment, part = joint_problem(state, observations, ids, tracks, weighed, sigma, _SOLVER, held)
    return adjustment, part.images.tolist()


def _judged(
    copy: MapCopy,
    adjustment: BundleAdjustment,
    window: list[MappedImage],
    held: NDArray[np.bool_],
    ids: Index,
    guided: list[int],
    result: UpdateResult,
    focal: float | None,
) -> MapUpdate:
    """The solution as the map takes it over, and what in it does not fit."""
    state, o = adjustment.state, adjustment.observations
    unit = _unit(window, held, state)
    poses = {
        image.tracks.position: (state.rotation[row], unit * state.translation[row])
        for row, image in enumerate(window)
        if not held[row]
    }
    affines = dict(zip(guided, zip((unit * state.scale).tolist(), state.shift.tolist(), strict=True), strict=True))
    units = np.array([1.0, 1.0, 1.0, unit, unit, unit])
    covariances = {p: _COVARIANCE_INFLATION * c * np.outer(units, units) for p, c in result.covariance.items()}
    errors = adjustment.reprojection_errors()
    limit = _GROSS * max(copy.options.inlier_px, 5.0 * float(np.median(errors)))
    typical = np.sqrt(o.mean_by_point(errors**2))
    good = (state.inverse_distance > _FARTHEST) & (typical < limit)
    return MapUpdate(
        window[-1].tracks.position, window[-1].tracks.depth, True, result.reason,
        ids[good], unit * state.points[good], ids[~good], poses, affines, covariances, focal,
    )  # fmt: skip


def _unit(window: list[MappedImage], held: NDArray[np.bool_], state: State) -> float:
    """Factor that keeps the length of the camera's path, so that poses already given still fit those to come.

    1 where the unit is not free: two cameras are constant, or a prior that knows its zero holds it.
    """
    depths = [image.tracks.depth for image in window if image.tracks.depth is not None]
    if held.sum() > 1 or any(not depth.free_shift for depth in depths):
        return 1.0
    before = np.array([image.pose[1] for image in window])  # the first camera is the world
    lengths = np.linalg.norm(before, axis=1).sum(), np.linalg.norm(state.translation, axis=1).sum()
    return float(lengths[0] / lengths[1]) if min(lengths) > 1e-9 else 1.0


def _spread(xy: Array, taken: NDArray[np.bool_], candidates: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """`count` of the candidates, taken in turn from the emptiest cells of a grid; older tracks come first."""
    cell = np.floor((xy - xy.min(0)) / np.maximum(np.ptp(xy, axis=0), 1e-9) * [15.99, 8.99]).astype(int)
    key = cell[:, 0] * 9 + cell[:, 1]
    load = np.bincount(key[taken], minlength=144)
    order = candidates[np.argsort(key[candidates], kind="stable")]
    first = np.searchsorted(key[order], np.arange(144))
    rank = np.arange(len(order)) - first[key[order]] + load[key[order]]
    return np.asarray(order[np.argsort(rank, kind="stable")[:count]])
