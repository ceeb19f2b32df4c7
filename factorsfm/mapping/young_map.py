"""What bends a young map: things that are laid over the images, and things that move by themselves.

A young map has few views and the shape that the prior guessed; it explains as parallax what is none. So what may bend
it is tried without, and where the rest is explained far better then, the map begins again with that alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.graph.window import Window
from factorsfm.mapping.group_readings import from_group
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.mapped_images import MappedImage, state_of
from factorsfm.mapping.registration import register_image
from factorsfm.mapping.starts import lift
from factorsfm.motion.at_rest import image_weights
from factorsfm.motion.burn_ins import CONTRADICTS, contradicts, resting
from factorsfm.motion.readings import Reading, most_likely, solution_from
from factorsfm.motion.turning import turning_groups
from factorsfm.support.options import PolishOptions

Index = NDArray[np.int64]

YOUNG_KEYFRAMES = 6  # up to which a map is easily bent: by burn-ins, then it begins again, or by what is no prior
_LEAST_KEYFRAMES = 3  # from which things that move may be told from the scene: two views show hardly more than a turn
_TRIAL_ITERATIONS = 5  # that tell whether what rests is at odds with the others
_FITS = 0.4  # times the assumed noise: the median error up to which nothing bends the map
_FITS_IN_NOISE = 0.8  # the same of noisy footage, beside what may well be captions
_MOST_BURNT_IN = 0.25  # of the image: captions, logos and time codes together cover less
_FAR_BETTER = 0.5  # of the cost of what fits badly by itself, with what rests: below, that is what bends it
_SOLVER = replace(PolishOptions(), tolerance=1e-3)
READING = replace(_SOLVER, iterations=20)


def scene_alone(copy: MapCopy, images: list[MappedImage], window: Window, ids: Index) -> Index:
    """Those of the tracks that are the scene, where others of a young map move by themselves; else those of the window.

    Args:
        window: as the graph has solved it; ids: all mapped tracks, those of the window among them.
    """
    few = len(copy.keyframes) < _LEAST_KEYFRAMES
    if few or typical_error(window) < _FITS * copy.options.pixel_sigma:
        return window.ids
    found = another_reading(copy, images, window, ids)
    return window.ids if found is None else ids[found.kept]


def another_reading(copy: MapCopy, images: list[MappedImage], window: Window, ids: Index) -> Reading | None:
    """The most likely reading of the keyframes, None where it is that of the map.

    Args:
        window, ids: see `scene_alone`.
    """
    seen = gather([image.tracks for image in images], ids, copy.focal)
    points = copy.points.at(ids)
    points[np.isin(ids, window.ids)] = window.points
    state = replace(state_of(images, points, copy.focal), rotation=window.rotation, translation=window.translation)
    readings = [Reading(np.arange(len(ids)), solution_from(state, seen, READING))]
    for group in turning_groups(seen, state.normalized(seen), copy.focal):
        if len(np.unique(seen.of(np.flatnonzero(group)).frame)) == len(images):
            readings.append(from_group(group, state, seen, READING))
    best = most_likely(readings, seen)[0]
    return readings[best] if best else None


def typical_error(window: Window) -> float:
    """Median of the reprojection errors, pixels."""
    return float(np.median(window.reprojection()[0]))


def resting_among(images: list[MappedImage], ids: Index, suspects: NDArray[np.bool_], focal: float) -> Index:
    """Those of the suspected tracks (a part of `ids`) that rest in the image while the others move.

    Empty where they cover more of the image than captions do: they may be the scene behind something that moves.
    """
    if not suspects.any():
        return ids[:0]
    seen = gather([image.tracks for image in images], ids, focal)
    found = suspects & resting(seen)
    return ids[found] if _share_of_image(found, seen) < _MOST_BURNT_IN else ids[:0]


def _share_of_image(points: NDArray[np.bool_], seen: Observations) -> float:
    return float(np.average(points[seen.point], weights=image_weights(seen)))


def burn_ins_of(window: Window, pixel_sigma: float) -> Index:
    """Tracks that rest in the image and contradict the others, when both go on from a solution with all of them.

    Where the others do not fit each other either, what rests may be the scene, and they what moves before it: it is
    burnt in then only if they are explained far better without it.

    Args:
        pixel_sigma: standard deviation of a tracked point, pixels.
    """
    together = _adjustment(window)
    rests = resting(together.observations)
    if not rests.any():
        return np.zeros(0, np.int64)
    others = np.nonzero(~rests)[0]
    alone = BundleAdjustment(
        together.state.of(others),
        together.observations.of(others),
        _SOLVER,
        ErrorModel(window.sigma),
        free=Free(held=together.held),
    )
    for adjustment in (together, alone):
        adjustment.solve(_TRIAL_ITERATIONS)
    fit = _FITS if _share_of_image(rests, together.observations) > _MOST_BURNT_IN else _FITS_IN_NOISE
    fits = np.median(alone.reprojection_errors()) < fit * pixel_sigma
    burnt_in = contradicts(together, alone, ~rests, CONTRADICTS if fits else _FAR_BETTER)
    return window.ids[rests] if burnt_in else np.zeros(0, np.int64)


def lifted_anew(copy: MapCopy, window: list[MappedImage], ids: Index) -> Index:
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


def _adjustment(window: Window) -> BundleAdjustment:
    """The landmarks and keyframes of a window without the prior, as a problem of the batch solver."""
    distance = np.linalg.norm(window.points, axis=1)
    state = State(
        window.rotation, window.translation, window.points / distance[:, None], 1.0 / distance, np.log([window.focal])
    )
    observations = Observations(window.frame, window.point, window.pixels)
    held = Free(held=~window.solved)
    return BundleAdjustment(state, observations, _SOLVER, ErrorModel(window.sigma), free=held)
