"""The objects of a result as film tools take them: a null with keys, and the points that hang from it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.objects.object_result import ObjectResult

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MovingNull:
    """An object.

    Attributes:
        name: letters, digits and underscores; begins with "object".
        numbers: (k,) of the frames with a key.
        world_from_object: (k, 4, 4).
        points: (n, 3) in its own coordinates; colors: (n, 3) uint8 RGB.
    """

    name: str
    numbers: list[int]
    world_from_object: Array
    points: Array
    colors: NDArray[np.uint8]


def moving_nulls(objects: tuple[ObjectResult, ...], first_frame: int) -> list[MovingNull]:
    """All objects, with names of their own; `first_frame`: number of frame 0 of the source."""
    found: list[MovingNull] = []
    for thing in objects:
        name = re.sub(r"\W", "_", thing.name, flags=re.ASCII)
        name = name if name.startswith("object") else f"object_{name}"
        while name in [other.name for other in found]:
            name += "_"
        matrices = np.tile(np.eye(4), (len(thing.frames), 1, 1))
        for matrix, frame in zip(matrices, thing.frames, strict=True):
            matrix[:3] = frame.world_from_object.matrix()
        numbers = [first_frame + frame.index for frame in thing.frames]
        found.append(MovingNull(name, numbers, matrices, thing.points, thing.colors))
    return found
