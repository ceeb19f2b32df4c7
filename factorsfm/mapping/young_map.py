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
from factorsfm.motion.burn_ins import contradicts, resting
from factorsfm.motion.readings import Reading, most_likely, solution_from
from factorsfm.motion.turning import turning_groups
from factorsfm.support.options import PolishOptions

Index = NDArray[np.int64]

YOUNG_KEYFRAMES = 6  # up to which a map is easily bent: by burn-ins, then it begins again, or by what is no prior
_LEAST_KEYFRAMES = 3  # from which things that move may be told from the scene: two views show hardly more than a turn
_TRIAL_ITERATIONS = 5  # that tell whether what rests is at odds with the others
_FITS = 0.4  # times the assumed noise: the median error up to which nothing bends the map
_SOLVER = replace(PolishOptions(), tolerance=1e-3)
_READING = replace(_SOLVER, iterations=20)


def scene_alone(copy: MapCopy, images: list[MappedImage], window: Window, ids: Index) -> Index:
    """Those of the tracks that are the scene, where others of a young map move by themselves; else those of the window.

    Args:
        window: as the graph has solved it; ids: all mapped tracks, those of the window among them.
    """
    known = _adjustment(window)
    young = _LEAST_KEYFRAMES <= len(copy.keyframes) <= YOUNG_KEYFRAMES
    if not young or np.median(known.reprojection_errors()) < _FITS * copy.options.pixel_sigma:
        return window.ids
    seen = gather([image.tracks for image in images], ids, copy.focal)
    state = state_of(images, copy.points.at(ids), copy.focal)
    together = solution_from(known.state, known.observations, _READING)
    readings = [Reading(np.searchsorted(ids, window.ids), together)]
    for group in turning_groups(seen, state.normalized(seen), copy.focal):
        if len(np.unique(seen.of(np.flatnonzero(group)).frame)) == len(images):
            readings.append(from_group(group, state, seen, _READING))
    return ids[readings[most_likely(readings, seen)[0]].kept]


def resting_among(images: list[MappedImage], ids: Index, suspects: NDArray[np.bool_], focal: float) -> Index:
    """Those of the suspected tracks (a part of `ids`) that rest in the image while the others move."""
    if not suspects.any():
        return ids[:0]
    return ids[suspects & resting(gather([image.tracks for image in images], ids, focal))]


def burn_ins_of(window: Window) -> Index:
    """Tracks that rest in the image and contradict the others, when both go on from a solution with all of them."""
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
    return window.ids[rests] if contradicts(together, alone, ~rests) else np.zeros(0, np.int64)


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
