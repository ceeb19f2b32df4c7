"""Objects and named points of a result as film tools take them: a null with keys, and the points that hang from it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.objects.object_result import ObjectResult
from factorsfm.result.supervised import NamedPoint

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Null:
    """An object, or a named point.

    Attributes:
        name: letters, digits and underscores; begins with "object" or "point".
        numbers: (k,) of the frames with a key.
        world_from_object: (k, 4, 4).
        points: (n, 3) in its own coordinates, none of a named point; colors: (n, 3) uint8 RGB.
    """

    name: str
    numbers: list[int]
    world_from_object: Array
    points: Array
    colors: NDArray[np.uint8]


def moving_nulls(objects: tuple[ObjectResult, ...], first_frame: int) -> list[Null]:
    """All objects, with names of their own; `first_frame`: number of frame 0 of the source."""
    found: list[Null] = []
    for thing in objects:
        name = _name("object", thing.name, found)
        matrices = np.tile(np.eye(4), (len(thing.frames), 1, 1))
        for matrix, frame in zip(matrices, thing.frames, strict=True):
            matrix[:3] = frame.world_from_object.matrix()
        numbers = [first_frame + frame.index for frame in thing.frames]
        found.append(Null(name, numbers, matrices, thing.points, thing.colors))
    return found


def point_nulls(points: Sequence[NamedPoint], number: int) -> list[Null]:
    """The named points that could be placed, with one key in the frame with this number."""
    found: list[Null] = []
    for point in points:
        if point.position is not None:
            matrix = np.eye(4)
            matrix[:3, 3] = point.position
            none = np.zeros((0, 3))
            name = _name("point", point.name, found)
            found.append(Null(name, [number], matrix[None], none, none.astype(np.uint8)))
    return found


def _name(kind: str, name: str, others: Sequence[Null]) -> str:
    name = re.sub(r"\W", "_", name, flags=re.ASCII)
    name = name if name.startswith(kind) else f"{kind}_{name}"
    while name in [other.name for other in others]:
        name += "_"
    return name
