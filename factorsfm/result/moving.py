"""What moves by itself in a shot: its tracks, and how much of the shot they are; written and read as moving.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.motion.neighbours import share_of_image
from factorsfm.result.runs import runs
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json, typed
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Of the image, from which a frame belongs to a stretch: tracks beside the rim of the image and in reflections stand out
# together now and then, on 1 % of it.
_LEAST_IMAGE = 0.02
_STEPS_PX = 100  # of a pixel in moving.json


@dataclass(frozen=True, slots=True)
class MovingStretch:
    """Frames in which something moves by itself.

    Attributes:
        first, last: indices of the frames.
        tracks, image: share of the tracks, and of the image, that move by themselves; means over the frames.
    """

    first: int
    last: int
    tracks: float
    image: float


@dataclass(frozen=True, slots=True)
class Moving:
    """Tracks that move by themselves: the cameras explain neither them nor their neighbours, and they take no part.

    Attributes:
        stretches: when there is enough of them to tell, in order.
        frame: (m,) index of the frame of each observation, ascending; track: (m,) which of the tracks it is of.
        xy: (m, 2) pixels, centres at integers (OpenCV).
    """

    stretches: tuple[MovingStretch, ...]
    frame: Index
    track: Index
    xy: Array

    def share_of_image(self, indices: Sequence[int]) -> float:
        """Mean over frames with these indices."""
        index = np.array(indices)
        return sum(part.image * float(np.mean((index >= part.first) & (index <= part.last))) for part in self.stretches)


def moving_in(images: Sequence[ImageTracks], indices: Sequence[int], judged: Index, moving: Index) -> Moving | None:
    """What moves by itself in the images of a shot, None where that is nowhere enough to tell.

    Args:
        images: with a pose, in order; indices: of their frames.
        judged: ids of the tracks that the cameras explain or not; moving: of those among them that move by themselves.
    """
    shares = np.zeros((len(images), 2))
    seen: list[tuple[Index, Index, Array]] = []
    for row, (tracks, index) in enumerate(zip(images, indices, strict=True)):
        known = np.isin(tracks.ids, judged)
        ids, xy = tracks.ids[known], tracks.pixels[known]
        moves = np.isin(ids, moving)
        if moves.any():
            shares[row] = moves.mean(), share_of_image(xy, moves, (tracks.camera.width, tracks.camera.height))
            seen.append((np.full(moves.sum(), index), ids[moves], xy[moves]))
    found = tuple(
        MovingStretch(int(indices[part.start]), int(indices[part.stop - 1]), *shares[part].mean(axis=0).tolist())
        for part in runs(shares[:, 1] >= _LEAST_IMAGE)
    )
    if not found:
        return None
    frame, track, xy = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return Moving(found, frame, np.unique(track, return_inverse=True)[1], xy)


# --- moving.json ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Track:
    frames: list[int]
    xy: list[list[float]]


@dataclass(frozen=True, slots=True)
class _Content:
    stretches: list[MovingStretch]
    tracks: list[_Track]


def moving_json(moving: Moving) -> dict[str, Any]:
    """The content of moving.json: the stretches, and by track the indices of its frames and where it is in them."""
    xy = np.round(moving.xy * _STEPS_PX) / _STEPS_PX
    order = np.argsort(moving.track, kind="stable")
    parts = np.split(order, np.nonzero(np.diff(moving.track[order]))[0] + 1)
    tracks = [_Track(moving.frame[part].tolist(), xy[part].tolist()) for part in parts]
    return asdict(_Content(list(moving.stretches), tracks))


def read_moving(path: Path) -> Moving | None:
    """What a moving.json says; None where there is no file.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return None
    content = typed(_Content, read_json(path, "what moves by itself"), "moving.json")
    for number, track in enumerate(content.tracks):
        if not track.frames or len(track.frames) != len(track.xy) or {len(place) for place in track.xy} != {2}:
            raise InputError(f"moving.json: track {number} has {len(track.frames)} frames and no place in each")
    if not content.tracks:
        raise InputError("moving.json: it has 0 tracks; at least 1 is expected")
    frame = np.concatenate([track.frames for track in content.tracks]).astype(np.int64)
    which = np.repeat(np.arange(len(content.tracks)), [len(track.frames) for track in content.tracks])
    xy = np.concatenate([track.xy for track in content.tracks]).astype(np.float64)
    if not np.isfinite(xy).all():
        raise InputError("moving.json: a place is not finite")
    order = np.argsort(frame, kind="stable")
    return Moving(tuple(content.stretches), frame[order], which[order], xy[order])
