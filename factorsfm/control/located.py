"""Control with its frames found among those of a shot or a set, by their names or indices."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.known import Control, FrameKey, Vector
from factorsfm.support.errors import InputError
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]


class NamedFrame(Protocol):
    """What is needed to find a frame."""

    @property
    def index(self) -> int: ...
    @property
    def name(self) -> str: ...


@dataclass(frozen=True, slots=True)
class LocatedControl:
    """Control with its frames found in a shot or a set.

    Attributes:
        position: of each frame among those of the source.
        names: of the frames, by position.
        marks: by frame: the marked points as tracks whose ids are rows of `Control.points`, in pixels of the frame's
            camera.
    """

    control: Control
    position: dict[FrameKey, int]
    names: list[str]
    marks: list[ImageTracks]


def find_frames(control: Control, frames: Sequence[tuple[int, str]]) -> dict[FrameKey, int]:
    """Position of each frame of the control among those with these indices and names.

    Raises:
        InputError: a frame is not there that may not be left out, or is meant twice where different ones are expected.
    """
    found = _positions(control.frames, frames)
    control = control.within(found.keys())
    missing = [key for key in control.frames if key not in found]
    if missing:
        raise InputError(f"control: there is no frame {missing[0]!r} among the {len(frames)} frames")
    _check_different([pose.frame for pose in control.poses], found)
    for keys in (*(point.marks for point in control.points), *(distance.frames for distance in control.distances)):
        _check_different(keys, found)
    return {key: found[key] for key in control.frames}


def _positions(keys: Iterable[FrameKey], frames: Sequence[tuple[int, str]]) -> dict[FrameKey, int]:
    """Position of each key that is a frame's index or its name, without its suffix or with another one."""
    stems = [_stem(PurePath(name).name) for _, name in frames]
    counts = Counter(stems)  # of a.jpg and a.png nobody knows which one "a" is
    by_stem: dict[FrameKey, int] = {stem: k for k, stem in enumerate(stems) if counts[stem] == 1}
    as_it_is, without_suffix = dict[FrameKey, int](), dict[FrameKey, int]()
    for position, ((index, _), stem) in enumerate(zip(frames, stems, strict=True)):
        as_it_is |= {index: position, str(index): position}
        if re.findall(r"0*(\d+)", stem)[-1:] == [str(index)]:  # it is a number, not a place among photographs
            without_suffix[str(index)] = position
    as_it_is |= by_stem | {name: position for position, (_, name) in enumerate(frames)}
    without_suffix |= by_stem  # an export gives the images of a video, and those of EXR plates, a suffix of their own
    found = dict[FrameKey, int]()
    for key in keys:
        if key in as_it_is:
            found[key] = as_it_is[key]
        elif isinstance(key, str) and _stem(key) in without_suffix:
            found[key] = without_suffix[_stem(key)]
    return found


def _stem(name: str) -> str:
    """A name without its suffix, which is not a number."""
    suffix = PurePath(name).suffix
    return name if suffix[1:].isdecimal() else name.removesuffix(suffix)


def _check_different(keys: Iterable[FrameKey], found: Mapping[FrameKey, int]) -> None:
    by_position: dict[int, FrameKey] = {}
    for key in keys:
        if by_position.setdefault(found[key], key) != key:
            raise InputError(f"control: {by_position[found[key]]!r} and {key!r} are the same frame")


def locate(
    control: Control,
    frames: Sequence[NamedFrame],
    in_camera: Callable[[int, Array], tuple[pycolmap.Camera, Array]],
) -> LocatedControl:
    """Find the frames of the control in a source.

    Args:
        in_camera: gives the camera of the frame at a position, and what pixels (n, 2) of the frame are in it.

    Raises:
        InputError: a frame is not there, a mark is where the lens has no inverse, or a point has none.
    """
    if bare := [point.name for point in control.points if point.pixels is None]:
        raise InputError(f'control: point {bare[0]} has no "pixels", and no track of this name is given (--tracks)')
    found = find_frames(control, [(frame.index, frame.name) for frame in frames])
    marked: dict[int, list[tuple[int, FrameKey, Vector]]] = defaultdict(list)
    for row, point in enumerate(control.points):
        for key, xy in point.marks.items():
            marked[found[key]].append((row, key, xy))
    marks = []
    for position, seen in sorted(marked.items()):
        camera, pixels = in_camera(position, np.array([xy for _, _, xy in seen], np.float64))
        tracks = ImageTracks(position, np.array([row for row, _, _ in seen]), pixels, camera)
        for (row, key, xy), good in zip(seen, tracks.invertible, strict=True):
            if not good:
                name = control.points[row].name
                raise InputError(f"control: point {name} at {list(xy)} in frame {key!r} is outside of the lens")
        marks.append(tracks)
    return LocatedControl(control.within(found.keys()), found, [frame.name for frame in frames], marks)
