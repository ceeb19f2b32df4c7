"""What the newest image has done to the map, beside its own pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class MapNews:
    """What is new of the map since the image before.

    Attributes:
        points: how many the map has gained.
        burn_ins: tracks that turned out to be laid over the images.
        starts_anew: whether the map was given up; begins_again: whether it goes on without what had bent it.
        note: what became of it, where that is out of the ordinary; else empty.
    """

    points: int = 0
    burn_ins: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    starts_anew: bool = False
    begins_again: bool = False
    note: str = ""
