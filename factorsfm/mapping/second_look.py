"""What is the scene, asked once more of a map that is young no longer and fits badly all the same.

While little has moved, one motion of the camera explains two things at once, one as near and the other as far, and the
young map may have gone with the wrong one. More keyframes tell. The map then takes over the cameras and the points of
the reading that explains them, in the unit of the depth prior, as a start does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.state import State
from factorsfm.graph.window import Window
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.young_map import READING, another_reading, typical_error
from factorsfm.motion.readings import reversed_scene, solution_from

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LOOKS = (8, 12, 16)  # keyframes with which a map is looked at: it takes as long as several updates
_BADLY = 1.2  # times the assumed noise: a median error that real tracks of one scene do not have
_THE_SAME = 0.85  # share of the map's landmarks above which a reading has the same scene
_FARTHEST = 1e-3  # smallest inverse distance of a point, in units of the median
_LEAST_GUIDED = 10  # points with a depth by which the unit of length is found


def scene_seen_later(copy: MapCopy, images: list[MappedImage], window: Window, ids: Index) -> Index:
    """Those of the tracks that are the scene, to which the copy is brought, if it is another one; else the window's.

    Args:
        window: as the graph has solved it; ids: all mapped tracks, those of the window among them.
    """
    looks = len(copy.keyframes) in _LOOKS and not window.constant.any() and not copy.added.numbers
    if not looks or typical_error(window) < _BADLY * copy.options.pixel_sigma:
        return window.ids
    found = another_reading(copy, images, window, ids)
    if found is None or np.isin(window.ids, ids[found.kept]).mean() > _THE_SAME:
        return window.ids
    kept, state = ids[found.kept], _nearer_first(found.adjustment)
    finite = state.inverse_distance > _FARTHEST * np.median(state.inverse_distance)
    kept, state = kept[finite], state.of(np.flatnonzero(finite))
    state = _in_unit_of_prior(copy, images, kept, state)
    for image, rotation, translation in zip(images, state.rotation, state.translation, strict=True):
        image.rotation, image.translation, image.affine = rotation, translation, None
    copy.points.set(kept, state.points)
    return kept


def _nearer_first(solved: BundleAdjustment) -> State:
    """The solution, or that with near and far exchanged if it fits better: from a turning camera either may follow."""
    other = solution_from(reversed_scene(solved.state), solved.observations, READING)
    return min((solved, other), key=lambda solution: solution.sigma).state


def _in_unit_of_prior(copy: MapCopy, images: list[MappedImage], ids: Index, state: State) -> State:
    """The state with the distances that the prior of the first image that has one gives to most, as at a start.

    Args:
        ids: of the points of the state.
    """
    for row, image in enumerate(images):
        depth = image.tracks.depth
        if depth is None:
            continue
        seen = np.isin(image.tracks.ids, ids) & depth.valid
        points = state.points[np.searchsorted(ids, image.tracks.ids[seen])]
        z = points @ state.rotation[row, 2] + state.translation[row, 2]
        front = z > 0.0
        if front.sum() >= _LEAST_GUIDED:
            said = float(np.median(depth.inverse_depth[seen][front]))
            unit = copy.unit * float(np.median(1.0 / z[front])) / said
            return replace(state, translation=unit * state.translation, inverse_distance=state.inverse_distance / unit)
    return state
