"""2-D tracks of the user: placed by hand, or made by another program, and read from its file.

The files are those that `export` writes, the table (CSV), Nuke's Tracker, CameraTracker's and 3DEqualizer's text, and
the keyframes that After Effects copies; and files of Blender with a movie clip.
"""

from __future__ import annotations

import csv
import io
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.export.formats import FORMATS
from factorsfm.export.shot import first_frame_of
from factorsfm.mending.blender_file import blender_tracks
from factorsfm.mending.nuke_tracker import nuke_tracks
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Plate = Literal["footage", "undistorted"]
_Curves = dict[str, dict[int, tuple[float, float]]]  # by name and number of the frame, in pixels of the format

DEFAULT_SIGMA_PX = 0.5  # of a place that a person has set with care; automatic trackers are better
_LARGEST = 1e6  # pixels and numbers of frames: beyond, a file holds something else
_LONGEST_NAME = 100
_LEAST_WEIGHT = 1e-3
_COLUMNS = ("track", "frame", "x", "y")  # of a table
_OTHER_FILE = (
    "neither a table with track, frame, x and y, nor a script with Nuke's Tracker4, nor CameraTracker's or "
    "3DEqualizer's text of 2-D tracks, nor After Effects' keyframes, nor a .blend file"
)
_MOST_SHOWN = 100  # characters of a line


@dataclass(frozen=True, slots=True)
class UserTrack:
    """A track.

    Attributes:
        name: as the user calls it.
        frames: (k,) numbers of the frames as in a result, ascending; a list does.
        xy: (k, 2) pixels with centres at integers; see `UserTracks`. A list does.
        weight: what the standard deviation is divided by.

    Raises:
        InputError: there is no place, a frame is there twice, or a value is none.
    """

    name: str
    frames: Index
    xy: Array
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _is_name(self.name):
            raise InputError(f"a track is called {self.name!r:.{_LONGEST_NAME}}; a name in one line is expected")
        try:
            frames, xy = np.asarray(self.frames, np.float64), np.asarray(self.xy, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f'track "{self.name}" has frames or places that are no numbers') from error
        if frames.ndim != 1 or xy.shape != (len(frames), 2) or not len(frames):
            raise InputError(f'track "{self.name}" has frames of shape {frames.shape} and places of shape {xy.shape}')
        if (np.diff(frames) <= 0).any():
            raise InputError(f'the frames of track "{self.name}" do not ascend')
        if not (np.abs(xy) < _LARGEST).all() or not (np.abs(frames) <= _LARGEST).all() or (frames % 1.0).any():
            raise InputError(f'track "{self.name}" has a place or a frame that is none')
        if not _LEAST_WEIGHT <= self.weight <= 1.0 / _LEAST_WEIGHT:
            raise InputError(f'the weight of track "{self.name}" is {self.weight:g}; 0.001 to 1000 is expected')
        object.__setattr__(self, "frames", frames.astype(np.int64))
        object.__setattr__(self, "xy", xy)


def _is_name(text: str) -> bool:
    return bool(text.strip()) and len(text) <= _LONGEST_NAME and text.isprintable()


@dataclass(frozen=True, slots=True)
class UserTracks:
    """Tracks that the user vouches for.

    Attributes:
        tracks: with different names.
        sigma: standard deviation of each coordinate of their places, pixels.
        on: the plate on which they lie: the "footage" with its distortion, or the footage "undistorted".
        from_bottom: whether their y counts upwards, from the bottom edge of the image (not from a pixel's centre).
        source: where they come from, for people.
        size: width and height of the image that they were placed in, pixels, if that is known.
        notes: what of their file takes no part, in sentences.

    Raises:
        InputError: there is no track, two have the same name, or the standard deviation is none.
    """

    tracks: Sequence[UserTrack]
    sigma: float = DEFAULT_SIGMA_PX
    on: Plate = "footage"
    from_bottom: bool = False
    source: str = "the tracks"
    size: tuple[int, int] | None = None
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not self.tracks:
            raise InputError(f"{self.source}: there is no track")
        names = [track.name for track in self.tracks]
        if len({*names}) < len(names):
            twice = next(name for k, name in enumerate(names) if name in names[:k])
            raise InputError(f'{self.source}: track "{twice}" is there twice')
        if not 1e-3 <= self.sigma <= 1e3:
            raise InputError(
                f"the standard deviation of the tracks is {self.sigma:g}; 0.001 to 1000 pixels is expected"
            )
        if self.on not in get_args(Plate):
            raise InputError(f'the tracks lie on "{self.on}"; one of {", ".join(get_args(Plate))} is expected')


def read_tracks(
    path: str | Path,
    *,
    first_number: int | None = None,
    first_frame: int | None = None,
    sigma: float = DEFAULT_SIGMA_PX,
    on: Plate | None = None,
) -> UserTracks:
    """Read tracks from a table, a Nuke script, the text of CameraTracker or 3DEqualizer, After Effects' keyframes, or a
    file of Blender, which Blender reads.

    Args:
        first_number: with which the numbered sequence begins that is the source; None for all other sources.
        first_frame: number of the first frame of the source in the file; None is that of an export.
        sigma: see `UserTracks`.
        on: see `UserTracks`; None is the plate of an export: "undistorted" for Nuke's Tracker, else "footage".

    Raises:
        InputError: the file cannot be read, or is none of these.
    """
    path = Path(path)
    if path.suffix.lower() == ".blend":
        return _of_blender(path, first_number, first_frame, sigma, on or "footage")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"tracks {path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"tracks {path}: {_OTHER_FILE}") from error
    format, read = _format_of(text, path)
    from_top = format in ("tracks-csv", "tracks-after-effects")
    shift = first_frame_of(first_number, first_frame, FORMATS[format].defaults)
    corner = np.array([0.5, 0.5 if from_top else 0.0])  # y from the bottom stays as it is
    try:
        tracks = [
            UserTrack(
                name.strip(),
                np.array(sorted(places), np.int64) - shift,
                np.array([places[number] for number in sorted(places)]) - corner,
            )
            for name, places in read(text).items()
        ]
    except (ValueError, LookupError, OverflowError, RecursionError, InputError) as error:
        raise InputError(f"tracks {path}: {error}") from error
    plate: Plate = on or ("undistorted" if format == "tracks-nuke" else "footage")
    size = _size_in_after_effects(text) if format == "tracks-after-effects" else None
    return UserTracks(tracks, sigma, plate, not from_top, f"tracks {path}", size)


def _of_blender(path: Path, first_number: int | None, first_frame: int | None, sigma: float, on: Plate) -> UserTracks:
    shift = first_frame_of(first_number, first_frame, FORMATS["tracks-blender"].defaults)
    try:
        clip = blender_tracks(path)
        tracks = [
            UserTrack(track.name.strip(), track.frames - shift, track.xy - PIXEL_CENTER, track.weight)
            for track in clip.tracks
        ]
    except InputError as error:
        raise InputError(f"tracks {path}: {error}") from error
    return UserTracks(tracks, sigma, on, source=f"tracks {path}", size=clip.size, notes=clip.notes)


def _format_of(text: str, path: Path) -> tuple[str, Callable[[str], _Curves]]:
    start = text.lstrip()
    if re.search(r"^\s*Tracker4\s*\{", text, re.MULTILINE):
        return "tracks-nuke", nuke_tracks
    if start.startswith("Adobe After Effects"):
        return "tracks-after-effects", _of_after_effects
    if re.match(r"\d+\s*\n", start):
        return "tracks-3de", _of_3de
    if re.match(r"TrackName\s", start):
        return "tracks-camera-tracker", _of_camera_tracker
    if "," in start.partition("\n")[0]:
        return "tracks-csv", _of_table
    raise InputError(f"tracks {path}: {_OTHER_FILE}")


def _of_table(text: str) -> _Curves:
    """A header with track, frame, x and y, and further columns that are not read."""
    reader = csv.DictReader(io.StringIO(text))
    found: _Curves = defaultdict(dict)
    whole = 0  # lines of whole rows
    try:
        columns = reader.fieldnames or []
        if missing := [name for name in _COLUMNS if name not in columns]:
            raise ValueError(f"the table has no column {missing[0]}; it has {', '.join(columns)[:_MOST_SHOWN]}")
        whole = reader.line_num
        for row in reader:
            track, number, x, y = (row[name] for name in _COLUMNS)
            if "\n" in f"{track}{number}{x}{y}":
                raise csv.Error
            _add(found[track or ""], track, number, x, y, f"line {reader.line_num}")
            whole = reader.line_num
    except csv.Error:
        raise ValueError(f"after line {whole} a row does not end, as where a quote is not closed") from None
    return found


def _of_3de(text: str) -> _Curves:
    """The number of tracks; then of each its name, colour, length, and frame, x and y of each place."""
    lines = iter(line for line in text.splitlines() if line.strip())
    found: _Curves = {}
    try:
        for _ in range(_count(next(lines), "tracks")):
            name = next(lines).strip()
            next(lines)
            if name in found:
                raise ValueError(f'track "{name}" is there twice')
            found[name] = {}
            for _ in range(_count(next(lines), f'places of track "{name}"')):
                number, x, y = (*next(lines).split(), "", "", "")[:3]
                _add(found[name], name, number, x, y, f'a line of track "{name}"')
    except StopIteration:
        raise ValueError("the text ends before its last track does") from None
    return found


def _of_camera_tracker(text: str) -> _Curves:
    """Of each track a line with its name and one with headings; then frame, x, y and correlation of each place."""
    found: _Curves = {}
    name = ""
    for k, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words[:1] == ["TrackName"]:
            name = line.strip().removeprefix("TrackName").strip()
            if name in found:
                raise ValueError(f'track "{name}" is there twice')
            found[name] = {}
        elif words and words[0] != "Frame":
            number, x, y = (*words, "", "")[:3]
            _add(found[name], name, re.sub(r"\.0*$", "", number), x, y, f"line {k}")
    return found


def _of_after_effects(text: str) -> _Curves:
    """Track points of trackers, and positions of layers; other properties are not read.

    The names of the layers are not in the text: a position is called by its place in it.
    """
    found: _Curves = {}
    places: dict[int, tuple[float, float]] | None = None
    for k, line in enumerate(text.splitlines(), start=1):
        words = line.strip().split("\t")
        if line[:1].strip():  # a property, or the first or the last line
            places, name = None, " ".join(words[1:-1])
            if words[-1] == "Feature Center" or words == ["Transform", "Position"]:
                name = name or f"position {len(found) + 1}"
                if name in found:
                    raise ValueError(f'track "{name}" is there twice')
                places = found[name] = {}
        elif places is not None and words[0] not in ("", "Frame"):
            number, x, y = (*words, "", "")[:3]
            _add(places, name, number, x, y, f"line {k}")
    return found


def _size_in_after_effects(text: str) -> tuple[int, int] | None:
    """Width and height of the footage with trackers; that of a layer with positions is of the layer alone."""
    said = re.findall(r"^\tSource (?:Width|Height)\t(\d+)\s*$", text, re.MULTILINE)
    return (int(said[0]), int(said[1])) if len(said) == 2 and "\tFeature Center" in text else None


def _count(text: str, what: str) -> int:
    if not text.strip().isdecimal():
        raise ValueError(f'"{text.strip()}" is no number of {what}')
    return int(text)


def _add(places: dict[int, tuple[float, float]], name: str | None, number: str, x: str, y: str, where: str) -> None:
    try:
        frame, place = int(number), (float(x), float(y))
    except (ValueError, TypeError):
        raise ValueError(f"{where} is {number!r}, {x!r}, {y!r}; a frame and two numbers are expected") from None
    if frame in places:
        raise ValueError(f'track "{name}" has frame {frame} twice')
    places[frame] = place
