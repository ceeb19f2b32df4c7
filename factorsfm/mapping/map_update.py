"""What a new keyframe does to the map: its depth, new points, and the graph solved for all that it concerns.

An update works on copies and touches nothing but the graph, so that it can run in another process, beside the
registration of the frames that follow; the mapper takes its result over when it is due.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors, on_window
from factorsfm.graph.keyframe_graph import KeyframeGraph, UpdateResult
from factorsfm.graph.live_isam import YOUNG
from factorsfm.graph.unit_of_length import unit_of_length
from factorsfm.graph.window import Window
from factorsfm.mapping.at_odds import share_at_odds, share_left_out
from factorsfm.mapping.depth_guidance import DepthGuidance
from factorsfm.mapping.graph_window import choose_landmarks, choose_window, measured_window
from factorsfm.mapping.landmarks import add_landmarks, mapped_landmarks, solve_alone
from factorsfm.mapping.live_covariance import window_covariance
from factorsfm.mapping.map_contents import MapContents
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.map_registration import fits_pose
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.prior_check import inconsistency
from factorsfm.mapping.second_look import scene_seen_later
from factorsfm.mapping.young_map import YOUNG_KEYFRAMES, burn_ins_of, lifted_anew, resting_among, scene_alone
from factorsfm.support.options import PolishOptions
from factorsfm.support.similarity import covariance_in_unit

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_GROSS = 4.0  # times the threshold of an inlier: a young map is wrong, too, and long tracks are precious
_YOUNG_ITERATIONS = 8  # divided by the number of keyframes
_SOLVER = replace(PolishOptions(), tolerance=1e-3)
_COVARIANCE_INFLATION = 20.0  # the errors of neighbouring tracks are correlated: so many tracks count as one
_LENS_KEYFRAMES = 6  # from which an unknown focal length is estimated
_LENS_SIGMA_PX = 0.3  # standard deviation of the errors above which what they say of the lens is chance
_SIGNIFICANT, _LEAST_CHANGE = 3.0, 0.005  # standard deviations, and logarithm, of a change of the unit of length
_FARTHEST = 1e-6  # smallest inverse distance of a point


def update_map(copy: MapCopy, graph: KeyframeGraph) -> MapUpdate:
    """New landmarks, and what the graph makes of all keyframes around the new one.

    Factors that the caller offers are taken as a whole, or refused where the update fails with them alone.
    """
    if len(copy.keyframes) == 1 or not (copy.offered or copy.added.numbers):
        return _extended(copy, graph)
    trial = _with_offered(copy)
    update = replace(_extended(trial, graph), unit=trial.unit / copy.unit, offered=len(copy.offered))
    if update.committed or not copy.offered:
        return update
    without = _extended(_with_offered(replace(copy, offered=())), graph)
    if not without.committed:
        return without
    return replace(without, offered=len(copy.offered), refused=f"the factors added are refused: {update.reason}")


def _with_offered(copy: MapCopy) -> MapCopy:
    """The map with all that is offered, in the unit of length that the factors determine."""
    added = AddedFactors.joined([copy.added, *copy.offered])
    unit, std = unit_of_length(added, MapContents(copy.keyframes, copy.points))
    if not copy.offered or abs(np.log(unit)) < max(_SIGNIFICANT * std, _LEAST_CHANGE):
        unit = 1.0
    return copy.scaled(unit, added, unit_held=bool(np.isfinite(std)))


def _extended(copy: MapCopy, graph: KeyframeGraph) -> MapUpdate:
    """`update_map` with the factors that the copy has."""
    o, newest = copy.options, copy.newest
    position, depth = newest.tracks.position, newest.tracks.depth
    if o.graph_depth and len(copy.keyframes) <= YOUNG_KEYFRAMES and (reason := inconsistency(copy.keyframes)):
        return MapUpdate(position, depth, False, reason, no_prior=True)
    guidance = DepthGuidance(o, copy.points)
    guidance.fit(newest)
    affine = {position: newest.affine} if newest.affine is not None else {}
    if len(copy.keyframes) == 1:
        return MapUpdate(position, depth, True, "the first keyframe", affines=affine)
    images, constant = choose_window(copy.keyframes, copy.named_frames)
    at_odds = share_at_odds(images, copy.points, copy.focal, o) if copy.asks_odds else None
    add_landmarks(copy, images, guidance)
    ids = mapped_landmarks(images, copy.points)
    if (seen := int(np.isin(newest.tracks.ids, ids).sum())) < o.min_inliers:
        return MapUpdate(position, depth, False, f"{seen} of {o.min_inliers} needed landmarks in the keyframe")
    # A young map has the shape that the prior guessed, and far to go; it is also cheap.
    iterations = max(o.graph_iterations, _YOUNG_ITERATIONS // len(copy.keyframes))
    fits, mapped = fits_pose(newest, ids, copy.points, copy.focal, o), ids
    contradicting, laid_over = ids[~fits], resting_among(images, ids, ~fits, copy.focal)
    ids, others = choose_landmarks(images, ids[fits], copy.added.tracks)
    others = np.union1d(others, np.setdiff1d(contradicting, laid_over))
    result = _solved(copy, graph, images, constant, ids, iterations)
    burn_ins = burn_ins_of(result.window, o.pixel_sigma)
    if len(burn_ins):
        tried, scene = ids, np.setdiff1d(ids, burn_ins)
    else:
        tried, scene = mapped, _scene(copy, graph, images, result.window, mapped)
    bent = not np.array_equal(scene, ids)
    removed, moving = ids[:0], 0
    if bent:  # once more, with the scene alone
        moving = len(tried) - len(burn_ins) - len(scene)
        ids = lifted_anew(copy, images, scene)
        removed, others = np.setdiff1d(tried, ids), np.setdiff1d(others, tried)
        result = _solved(copy, graph, images, constant, ids, _YOUNG_ITERATIONS)
    if not result.committed:
        return MapUpdate(position, depth, False, result.reason, mirrored=result.mirrored)
    update = judged(copy, images, result)
    if len(others):
        update = solve_alone(copy, images, update, others, guidance, contradicting)
    removed = np.concatenate([update.removed, removed, laid_over])
    return replace(
        update,
        removed=np.unique(removed),
        burn_ins=np.union1d(burn_ins, laid_over),
        moving=moving,
        at_odds=share_left_out(newest.tracks, mapped, scene) if moving else at_odds,
        begins_again=bent and (moving > 0 or len(copy.keyframes) <= YOUNG_KEYFRAMES),
    )


def _scene(copy: MapCopy, graph: KeyframeGraph, images: list[MappedImage], window: Window, mapped: Index) -> Index:
    """The landmarks that are the scene: those of the window, unless something that moves by itself has bent the map."""
    if len(copy.keyframes) <= YOUNG_KEYFRAMES:
        return scene_alone(copy, images, window, mapped)
    scene = scene_seen_later(copy, images, window, mapped)
    if not np.array_equal(scene, window.ids):
        graph.start_anew()
    return scene


def _solved(
    copy: MapCopy,
    graph: KeyframeGraph,
    images: list[MappedImage],
    constant: NDArray[np.bool_],
    ids: Index,
    iterations: int,
) -> UpdateResult:
    """What the graph makes of some keyframes and landmarks, as the copy has them now."""
    window = measured_window(images, constant, ids, copy.points, copy.focal, copy.options)
    window = replace(
        window,
        unknown_lens=copy.refine_focal,
        open_lens=copy.refine_focal and len(copy.keyframes) >= _LENS_KEYFRAMES and window.sigma <= _LENS_SIGMA_PX,
        unit=copy.unit,
        unit_held=copy.unit_held,
    )
    added, constants = on_window(copy.added, window, MapContents(copy.keyframes, copy.points))
    return graph.update(window, iterations, added, constants)


def judged(copy: MapCopy, images: list[MappedImage], result: UpdateResult) -> MapUpdate:
    """The solution as the map takes it over, and what in it does not fit."""
    unit = _unit(images, result.window)
    window = result.window.scaled(unit)
    solved = np.flatnonzero(window.solved).tolist()
    poses = {images[row].tracks.position: (window.rotation[row], window.translation[row]) for row in solved}
    affines = {}
    if (d := window.depths) is not None:
        guided = [images[row].tracks.position for row in d.image]
        affines = dict(zip(guided, zip(d.scale.tolist(), d.shift.tolist(), strict=True), strict=True))
    position = {image.tracks.frame: image.tracks.position for image in images}
    constant = [image for image, held in zip(images, window.constant, strict=True) if held]
    covariances = {
        position[k]: window_covariance(
            poses[position[k]], covariance_in_unit(_COVARIANCE_INFLATION * c, unit), constant
        )
        for k, c in result.covariance.items()
    }
    errors, depth = window.reprojection()
    limit = _GROSS * max(copy.options.inlier_px, 5.0 * float(np.median(errors)))
    count = np.bincount(window.point, minlength=len(window.ids))
    typical = np.sqrt(np.bincount(window.point, errors**2, len(window.ids)) / np.maximum(count, 1))
    behind = np.bincount(window.point, depth < _FARTHEST, len(window.ids)) > 0.5 * count
    good = (typical < limit) & ~behind
    return MapUpdate(
        images[-1].tracks.position, images[-1].tracks.depth, True, result.reason,
        window.ids[good], window.points[good], window.ids[~good], poses, affines, covariances,
        window.focal if window.focal != copy.focal else None, added=result.added, misfit=result.misfit,
    )  # fmt: skip


def _unit(images: list[MappedImage], window: Window) -> float:
    """Factor that keeps the length of the camera's path, so that poses already given still fit those to come.

    1 where the unit is not free: the graph holds it, or a prior that knows its zero does.
    """
    depths = [image.tracks.depth for image in images if image.tracks.depth is not None]
    held = window.unit_held or window.constant.any() or any(not depth.free_shift for depth in depths)
    if len(images) > YOUNG or held:
        return 1.0
    before = np.array([image.pose[1] for image in images])  # the first camera is the world
    lengths = np.linalg.norm(before, axis=1).sum(), np.linalg.norm(window.translation, axis=1).sum()
    return float(lengths[0] / lengths[1]) if min(lengths) > 1e-9 else 1.0
