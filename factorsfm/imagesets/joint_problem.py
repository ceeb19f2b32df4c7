"""What a reconstruction and the images that were registered on it observe together, and the solution for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.options import PolishOptions

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_SAME_PX = 0.1  # a keypoint this near to an observation is the same
_CELL_PX = 0.5  # side of the cells in which a keypoint is looked for
_OUTLIER_SIGMAS = 12.0  # a match with a larger reprojection error is wrong
_PASSES = 2  # after the first one, wrong matches are left out
_OPTIONS = replace(PolishOptions(), iterations=30)


@dataclass(slots=True)
class MatchedImage:
    """An image that takes part.

    Attributes:
        frame: what is known of it; position: among the frames of the extended result.
        file: its copy in the work folder; size: (width, height).
        ids: (n,) its tracks, ascending; xy: (n, 2) where they are, in pixels of the result's camera with centres at
            integers; rgb: (n, 3) their colours.
    """

    frame: FrameResult
    position: int
    file: str
    size: tuple[int, int]
    ids: Index
    xy: Array
    rgb: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Observed:
    """Observations of the joint problem.

    Attributes:
        frame: (m,) positions of the frames in the extended result.
        point: (m,) points: first those of the result, then the mapped tracks.
        xy: (m, 2) pixels of the result's camera, centres at integers.
    """

    frame: Index
    point: Index
    xy: Array

    def only(self, keep: NDArray[np.bool_]) -> Observed:
        """Those of a mask (m,)."""
        return Observed(self.frame[keep], self.point[keep], self.xy[keep])


@dataclass(frozen=True, slots=True)
class Solved:
    """The joint problem after its adjustment.

    Attributes:
        positions: of its cameras, in the extended result.
        points: which of all points take part.
    """

    adjustment: BundleAdjustment
    positions: Index
    points: Index

    @property
    def observed_frame(self) -> Index:
        """(m,) position in the extended result of the frame of each observation."""
        return self.positions[self.adjustment.observations.frame]

    @property
    def observed_point(self) -> Index:
        """(m,) which of all points each observation is of."""
        return self.points[self.adjustment.observations.point]


def observed_together(
    base: Reconstruction, views: Sequence[MatchedImage], ids: Index, old: Set[int], new: Set[int]
) -> Observed:
    """All observations in registered frames: those of the result, and those of tracks that are none of its points.

    Args:
        ids: of the mapped tracks, ascending.
        old, new: positions of the frames of the result, and of those that were registered on it.
    """
    count = len(base.points)
    point_of = count + np.arange(len(ids))
    for row, known in _same_points(base, views, ids, old).items():
        point_of[row] = known
    frame, point, xy = [base.observation_frame], [base.observation_point], [base.observation_xy]
    for view in views:
        if view.position not in old and view.position not in new:
            continue
        here = np.flatnonzero(np.isin(view.ids, ids))
        points = point_of[np.searchsorted(ids, view.ids[here])]
        # What an image of the result sees of its points is there already.
        mine = (points >= count) | (view.position in new)
        points, first = np.unique(points[mine], return_index=True)
        frame.append(np.full(len(points), view.position))
        point.append(points)
        xy.append(view.xy[here[mine][first]])
    found = Observed(np.concatenate(frame), np.concatenate(point), np.concatenate(xy))
    return found.only(np.isin(found.frame, [*old, *new]))


def _same_points(base: Reconstruction, views: Sequence[MatchedImage], ids: Index, old: Set[int]) -> dict[int, int]:
    """Rows of the mapped tracks (in `ids`) that are points of the result: the same keypoints of its images."""
    same: dict[int, int] = {}
    for view in views:
        if view.position not in old:
            continue
        mine = np.flatnonzero(base.observation_frame == view.position)
        here = np.flatnonzero(np.isin(view.ids, ids))
        _, a, b = np.intersect1d(_cells(view.xy[here]), _cells(base.observation_xy[mine]), return_indices=True)
        near = np.linalg.norm(view.xy[here[a]] - base.observation_xy[mine[b]], axis=1) < _SAME_PX
        rows = np.searchsorted(ids, view.ids[here[a[near]]])
        for row, point in zip(rows.tolist(), base.observation_point[mine[b[near]]].tolist(), strict=True):
            same.setdefault(row, point)
    return same


def _cells(xy: Array) -> Index:
    x, y = np.rint(xy / _CELL_PX).astype(np.int64).T
    return np.asarray((y << 32) + x)


def solve(
    camera: pycolmap.Camera,
    observed: Observed,
    poses: Mapping[int, tuple[Array, Array]],
    places: Array,
    held: Set[int],
) -> Solved:
    """Adjust cameras and points; wrong matches are left out after a first pass.

    Args:
        poses: rotation and translation of each camera, by position in the extended result.
        places: (n, 3) all points.
        held: positions of the cameras that stay where they are.
    """
    positions = np.array(sorted(poses))
    free = Free(held=np.isin(positions, list(held)))
    rotation, translation = (np.array(part) for part in zip(*(poses[p] for p in positions.tolist()), strict=True))
    focal = camera.mean_focal_length()
    pixels = focal * normalized_from_pixels(camera, observed.xy)
    good = np.isfinite(pixels).all(axis=1)
    for _ in range(_PASSES):
        seen = np.bincount(observed.point, good, len(places))
        good &= seen[observed.point] >= 2
        order = np.flatnonzero(good)
        order = order[np.lexsort((observed.frame[order], observed.point[order]))]
        points, point = np.unique(observed.point[order], return_inverse=True)
        observations = Observations(np.searchsorted(positions, observed.frame[order]), point.reshape(-1), pixels[order])
        distance = np.linalg.norm(places[points], axis=1)
        state = State(rotation, translation, places[points] / distance[:, None], 1.0 / distance, np.log([focal]))
        start = BundleAdjustment(state, observations, _OPTIONS, ErrorModel(1.0), free=free)
        sigma = coordinate_sigma(start.reprojection_errors())
        adjustment = BundleAdjustment(state, observations, _OPTIONS, ErrorModel(sigma), free=free)
        state = adjustment.solve()
        rotation, translation = state.rotation, state.translation
        places = places.copy()
        places[points] = state.points
        sigma = coordinate_sigma(adjustment.reprojection_errors())
        good[order] = adjustment.reprojection_errors() < _OUTLIER_SIGMAS * sigma
    # Errors that neighbours share count once.
    sigma *= float(np.sqrt(adjustment.error_inflation()))
    final = BundleAdjustment(adjustment.state, observations, _OPTIONS, ErrorModel(sigma), free=free)
    return Solved(final, positions, np.asarray(points))
