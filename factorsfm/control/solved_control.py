"""Control in rows of a solution: its poses, points and lengths in the frames that are solved."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.state import State
from factorsfm.control.known import KnownDistance, KnownHeight, KnownPose
from factorsfm.control.located import LocatedControl
from factorsfm.control.residuals import (
    DistanceItem,
    HeightItem,
    Item,
    MarkItem,
    Place,
    PositionItem,
    RotationItem,
)
from factorsfm.mapping.triangulation import triangulate

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MARK_PX = 5.0  # largest error of a mark where its point starts


class SolvedControl:
    """The control of the solved frames, in rows of a state.

    Args:
        marks: of all points of the control in the solved frames.
        frames: position of each solved frame in the source.

    Attributes:
        poses: row and pose; held: those that are exact.
        distances: name, ends, and the known distance; heights: name, frame, three points, and the known height.
        marks: of the points in the frames (rows).
        places: (p, 3) marked points in the world of the solution, NaN where they are not known yet; usable: (p,).
        names: of the frames; unused: what is left out, and why.
        placed: whether the control has a world of its own: positions or rotations, not lengths alone.
    """

    def __init__(self, located: LocatedControl, marks: Observations, frames: list[int], state: State) -> None:
        control = located.control
        self.points, self.marks, self.unused = control.points, marks, list[str]()
        self.placed = bool(control.poses) or any(point.position is not None for point in control.points)
        self.names = [located.names[position] for position in frames]
        row_of = {position: row for row, position in enumerate(frames)}
        rows = {key: row_of[position] for key, position in located.position.items() if position in row_of}
        for key in control.frames:
            if key not in rows:
                self.unused.append(f"frame {key} is not registered, or not among those that are solved together")
        seen = np.bincount(marks.point, minlength=len(control.points))
        self.places = triangulated(state, marks, seen)
        ends: dict[str, Place] = {}
        self.usable = np.zeros(len(seen), bool)
        for row, point in enumerate(control.points):
            if np.isfinite(self.places[row, 0]) or (point.position is not None and seen[row]):
                ends[point.name], self.usable[row] = Place(row), True
            else:
                self.unused.append(f"point {point.name} cannot be placed: {seen[row]} usable marks")
        self.poses = [(rows[pose.frame], pose) for pose in control.poses if pose.frame in rows]
        self.held = [(row, pose) for row, pose in self.poses if pose.held]
        self.distances: list[tuple[str, tuple[Place, ...], KnownDistance]] = []
        for known in control.distances:
            places = [Place(rows[key], camera=True) for key in known.frames if key in rows]
            places += [ends[name] for name in known.points if name in ends]
            if len(places) == 2:
                name = " to ".join([*(f"frame {key}" for key in known.frames), *known.points])
                self.distances.append((f"distance {name}", tuple(places), known))
        self.heights: list[tuple[str, int, tuple[Place, ...], KnownHeight]] = []
        for height in control.heights:
            if height.frame in rows and all(name in ends for name in height.above):
                three = tuple(ends[name] for name in height.above)
                self.heights.append((f"height of frame {height.frame}", rows[height.frame], three, height))

    def items(self) -> list[Item]:
        """Everything that has a standard deviation, as residuals."""
        items: list[Item] = []
        for row, pose in self.poses:
            name = self.names[row]
            if pose.position is not None and pose.sigma:
                place, position = Place(row, camera=True), np.asarray(pose.position, np.float64)
                items.append(PositionItem(f"position of {name}", place, position, pose.sigma))
            if pose.cam_from_world is not None and pose.rotation_sigma:
                items.append(RotationItem(f"rotation of {name}", row, rotation_of(pose), pose.rotation_sigma))
        for row, point in enumerate(self.points):
            if self.usable[row] and point.position is not None and point.sigma:
                items.append(PositionItem(f"point {point.name}", Place(row), np.asarray(point.position), point.sigma))
        marks = self.marks
        for row, mark, pixels in zip(marks.frame.tolist(), marks.point.tolist(), marks.pixels, strict=True):
            if self.usable[mark]:
                name = f"point {self.points[mark].name} in {self.names[row]}"
                items.append(MarkItem(name, row, Place(mark), pixels, self.points[mark].pixel_sigma))
        for name, (a, b), distance in self.distances:
            items.append(DistanceItem(name, (a, b), distance.length, distance.sigma))
        for name, row, (a, b, c), height in self.heights:
            items.append(HeightItem(name, row, (a, b, c), height.length, height.sigma))
        return items


def rotation_of(pose: KnownPose) -> Array:
    """(3, 3) cam_from_world of a pose whose rotation is known."""
    return np.asarray(pycolmap.Rotation3d(np.asarray(pose.cam_from_world, np.float64)).matrix())


def triangulated(state: State, marks: Observations, seen: Index) -> Array:
    """(p, 3) points that two frames see, in the world of the solution; NaN for the others."""
    places = np.full((len(seen), 3), np.nan)
    several = np.nonzero(seen >= 2)[0]
    if not len(several):
        return places
    typical = float(np.median(state.inverse_distance))
    found = triangulate(
        state, marks.of(several), inlier_px=_MARK_PX, sigma=1.0, fallback=np.full(len(several), typical)
    )
    good = found.inverse_distance > 1e-3
    places[several[good]] = found.bearing[good] / found.inverse_distance[good, None]
    return places
