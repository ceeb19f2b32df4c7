"""Which keyframes and landmarks an update of the graph is about, and what was measured of them.

The images of a set are keyframes, too, in the order in which they joined the map instead of that of time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.noise import typical_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import prior_values
from factorsfm.graph.window import DepthMeasurements, Window
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.priors.affine import KNOWN_SHIFT_SIGMA, SCALE_SIGMA, SHIFT_SIGMA
from factorsfm.support.options import MapperOptions
from factorsfm.tracks.image_tracks import shared_tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FREE_KEYFRAMES = 16  # that an update solves for; those before are constant
_HELD_KEYFRAMES = 8  # constant ones that take part, with what they saw
LEAST_SHARED = 30  # landmarks by which a constant keyframe takes part
_MOST_LANDMARKS = 900  # in the graph
_LARGEST_SIGMA_PX = 3.0
_DEPTH_SIGMA = 0.6  # relative error of a network at a landmark, its smooth part included, as it usually is


def taking_part(keyframes: list[MappedImage], named: set[int]) -> tuple[list[MappedImage], list[MappedImage]]:
    """Those before the newest ones that share most with the last, and the newest ones, in order of time.

    Args:
        named: frames that take part in any case, since factors of the caller name them.
    """
    free = keyframes[-_FREE_KEYFRAMES:]
    before = keyframes[: -len(free)]
    shared = np.array([shared_tracks(image.tracks, keyframes[-1].tracks) for image in before], np.int64)
    held = np.array([image.tracks.frame in named for image in before], bool)
    rank = np.argsort(-shared, kind="stable")
    chosen = np.union1d(rank[:_HELD_KEYFRAMES], np.flatnonzero(held))
    return [before[k] for k in chosen], free


def choose_window(keyframes: list[MappedImage], named: set[int]) -> tuple[list[MappedImage], NDArray[np.bool_]]:
    """The keyframes that take part, in order of time, and which of them are constant; `named` as in `taking_part`."""
    before, free = taking_part(keyframes, named)
    window = before + free
    shared = np.array([shared_tracks(image.tracks, free[-1].tracks) for image in before] + [0] * len(free))
    rows, constant = window_rows(shared, np.arange(len(window)) >= len(before), _HELD_KEYFRAMES)
    return [window[k] for k in rows], constant


def window_rows(shared: Index, free: NDArray[np.bool_], most_held: int) -> tuple[Index, NDArray[np.bool_]]:
    """Rows (ascending) of the keyframes that take part, and which of them are constant.

    Args:
        shared: (k,) tracks that each keyframe shares with the newest one, the last.
        free: (k,) which of them are solved for; of the others those that share most are constant.
        most_held: how many at most.
    """
    others = np.flatnonzero(~free)
    held = others[np.argsort(-shared[others], kind="stable")[:most_held]]
    held = held[shared[held] >= LEAST_SHARED]
    rows = np.sort(np.concatenate([held, np.flatnonzero(free)]))
    constant = ~free[rows]
    if len(others) and constant.sum() < 2:
        constant[:2] = True  # two constant cameras keep place and size
    return rows, constant


def choose_landmarks(
    images: list[MappedImage], ids: Index, named: set[int], most: int | None = None
) -> tuple[Index, Index]:
    """Landmarks that become variables of the graph, and points that are solved alone, with the new poses.

    In the graph are those that factors of the caller name, those that the newest keyframe sees, and of the others those
    that most keyframes see.

    Args:
        named: tracks; most: in the graph, by default as many as in that of a video.
    """
    most = most or _MOST_LANDMARKS
    if len(ids) <= most:
        return ids, ids[:0]
    seen = np.sum([np.isin(ids, image.tracks.ids) for image in images], axis=0)
    above = len(images) + 1
    first = above * np.isin(ids, images[-1].tracks.ids) + 2 * above * np.isin(ids, sorted(named))
    rank = np.argsort(-(seen + first), kind="stable")
    inside = np.zeros(len(ids), bool)
    inside[rank[:most]] = True
    return ids[inside], ids[~inside]


def measured_window(
    images: list[MappedImage],
    constant: NDArray[np.bool_],
    ids: Index,
    points: PointMap,
    focal: float,
    options: MapperOptions,
) -> Window:
    """The window of the graph: keyframes and landmarks as the map has them, and their measurements.

    Args:
        images: keyframes, the newest last; constant: (k,) which of their poses do not change; ids: of the landmarks.
    """
    tracks = [image.tracks for image in images]
    observations = gather(tracks, ids, focal)
    window = Window(
        keyframes=np.array([image.frame for image in tracks]),
        constant=constant,
        rotation=np.array([image.rotation for image in images]),
        translation=np.array([image.translation for image in images]),
        ids=ids,
        points=points.at(ids),
        frame=observations.frame,
        point=observations.point,
        pixels=observations.pixels,
        focal=focal,
        sigma=1.0,
    )
    typical = typical_sigma(window.reprojection()[0])
    depths = _depths(images, observations, ids) if options.graph_depth else None
    return replace(window, sigma=min(max(options.pixel_sigma, typical), _LARGEST_SIGMA_PX), depths=depths)


def _depths(images: list[MappedImage], observations: Observations, ids: Index) -> DepthMeasurements | None:
    """The prior at the landmarks, as good as networks usually are: the shot has not shown yet how good this one is."""
    values = prior_values([image.tracks for image in images], observations, ids)
    if values is None:
        return None
    scale, shift = np.array([images[row].affine or (1.0, 0.0) for row in values.rows]).T
    point = observations.point[values.at]
    repeated = np.sqrt(np.bincount(point, minlength=len(ids))[point])  # its images repeat the same error
    return DepthMeasurements(
        values.rows, scale, shift, values.image, point, values.inverse_depth,
        _DEPTH_SIGMA * scale[values.image] * repeated, SCALE_SIGMA,
        SHIFT_SIGMA if values.free_shift else KNOWN_SHIFT_SIGMA,
    )  # fmt: skip
