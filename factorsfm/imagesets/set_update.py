"""What a new image does to the map of a set: the graph solved for it and the images that share most with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.window import Window
from factorsfm.mapping.depth_guidance import DepthGuidance
from factorsfm.mapping.graph_window import LEAST_SHARED, choose_landmarks, measured_window, window_rows
from factorsfm.mapping.landmarks import mapped_landmarks, solve_alone
from factorsfm.mapping.map_copy import MapCopy, MapUpdate
from factorsfm.mapping.map_update import judged

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_FREE_IMAGES = 6  # that an update solves for, the newest one and those that share most with it
_HELD_IMAGES = 4  # constant ones that take part
_LANDMARKS = 300  # in the graph


def update_set(copy: MapCopy, graph: KeyframeGraph, shared: Index, held: Mask) -> tuple[MapUpdate, float]:
    """The images that share most with the newest one, and the points that they see.

    Args:
        copy: its keyframes are the registered images, the first one the world.
        shared: (k,) tracks that each has in common with the newest one; held: (k,) whose poses are given.

    Returns:
        What the map may take over, and the median error of the image that fits worst (pixels).
    """
    rows, constant = window_rows(shared, _free(shared, held), _HELD_IMAGES)
    images = [copy.keyframes[k] for k in rows]
    ids = mapped_landmarks(images, copy.points)
    newest = copy.newest.tracks
    if (seen := int(np.isin(newest.ids, ids).sum())) < copy.options.min_inliers:
        reason = f"{seen} of {copy.options.min_inliers} needed landmarks in the image"
        return MapUpdate(newest.position, None, False, reason), np.inf
    ids, others = choose_landmarks(images, ids, set(), _LANDMARKS)
    window = measured_window(images, constant, ids, copy.points, copy.focal, copy.options)
    result = graph.update(window, copy.options.graph_iterations)
    if not result.committed:
        return MapUpdate(newest.position, None, False, result.reason), np.inf
    update = judged(copy, images, result)
    if len(others) and not constant.any():  # else the map as a whole stays; what is left is for the adjustment of all
        update = solve_alone(copy, images, update, others, DepthGuidance(copy.options, copy.points), others[:0])
    return update, _worst_error(result.window)


def _worst_error(window: Window) -> float:
    """Median error of the image that fits its landmarks worst (pixels)."""
    errors, _ = window.reprojection()
    return max(float(np.median(errors[window.frame == row])) for row in np.unique(window.frame).tolist())


def _free(shared: Index, held: Mask) -> Mask:
    """(k,) which images are solved for: all of a small map, else neither the world nor what the newest hardly sees."""
    count = len(shared)
    if count <= _FREE_IMAGES and not held.any():
        return np.ones(count, bool)
    rank = np.where(held | (shared < LEAST_SHARED), 0, shared)
    rank[0], rank[-1] = 0, np.iinfo(np.int64).max
    free = np.zeros(count, bool)
    free[np.argsort(-rank, kind="stable")[:_FREE_IMAGES]] = True
    return free & (rank > 0)
