"""The tracks as 2-D curves, for programs that match-move: a table, Nuke, 3DEqualizer, Blender, After Effects."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.export.footage import Sequence, background
from factorsfm.export.shot import Shot

Array = NDArray[np.float64]

_NUKE_COLUMNS = (
    "5 1 20 enable e 1", "3 1 75 name name 1", "2 1 58 track_x track_x 1", "2 1 58 track_y track_y 1",
    "2 1 63 offset_x offset_x 1", "2 1 63 offset_y offset_y 1", "4 1 27 T T 1", "4 1 27 R R 1", "4 1 27 S S 1",
    "2 0 45 error error 1", "1 1 0 error_min error_min 1", "1 1 0 error_max error_max 1",
    *(f"1 1 0 {area}_{side} {area}_{side} 1" for area in ("pattern", "search") for side in "xyrt"),
    "2 1 0 key_track key_track 1",
    *(f"2 1 0 key_{area}_{side} key_{area}_{side} 1" for area in ("search", "track") for side in "xyrt"),
    *(f"2 1 0 key_centre_offset_{side} key_centre_offset_{side} 1" for side in "xy"),
)  # fmt: skip
_NOT_IN_NUKE = re.compile(r'["\\\[\]{}$]')  # signs that mean something in a text of its scripts
_PATTERN, _SEARCH = "-12 -12 12 12", "-24 -24 24 24"  # areas of a track around its place, pixels

_BLENDER = """
import bpy

if DATA["footage"]:
    clip = bpy.data.movieclips.load(DATA["footage"])
    clip.frame_start = DATA["frame_start"]
    bpy.context.scene.active_clip = clip  # a clip without a user is not saved
else:
    clip = bpy.data.movieclips[0]  # the tracks are for the clip that is open
for name, frames, places in DATA["tracks"]:
    track = clip.tracking.tracks.new(name=name, frame=frames[0])
    for k, (frame, place) in enumerate(zip(frames, places)):
        track.markers.insert_frame(frame, co=place)
        if k + 1 == len(frames) or frames[k + 1] != frame + 1:  # the track ends, or pauses
            track.markers.insert_frame(frame + 1, co=place).mute = True
"""

_AFTER_EFFECTS = """
(function () {
    var composition = app.project.activeItem;
    if (!(composition instanceof CompItem)) { alert("Open the composition of the footage first."); return; }
    app.beginUndoGroup("factorsfm tracks");
    for (var i = 0; i < DATA.tracks.length; i++) {
        var layer = composition.layers.addNull();
        layer.name = DATA.tracks[i].name;
        layer.property("Anchor Point").setValue([0, 0]);
        layer.property("Position").setValuesAtTimes(DATA.tracks[i].times, DATA.tracks[i].places);
        layer.inPoint = DATA.tracks[i].times[0];
        layer.outPoint = DATA.tracks[i].times[DATA.tracks[i].times.length - 1] + composition.frameDuration;
    }
    app.endUndoGroup();
})();
"""


@dataclass(frozen=True, slots=True)
class Track:
    """A track in the registered frames.

    Attributes:
        name: see `Reconstruction.track_names`.
        numbers: (k,) of the frames in the timeline, ascending.
        xy, undistorted: (k, 2) pixels from the top left corner of the image, on the footage, and on footage without
            distortion through the same pinhole.
        error: (k,) reprojection error, pixels.
    """

    name: str
    numbers: NDArray[np.int64]
    xy: Array
    undistorted: Array
    error: Array


def tracks_of(shot: Shot) -> Iterator[Track]:
    """The tracks of all points, in their order; where the lens has no inverse, a track has a gap."""
    result = shot.reconstruction
    number = np.array([shot.first_frame + frame.index for frame in result.frames])
    registered = np.array([frame.registered for frame in result.frames])
    xy = result.observation_xy + 0.5
    flat = np.full_like(xy, np.nan)
    for position, frame in enumerate(result.frames):
        mine = result.observation_frame == position
        if frame.registered and mine.any():
            flat[mine] = _undistorted(result.camera_of(frame), xy[mine])
    rows = np.flatnonzero(registered[result.observation_frame] & np.isfinite(flat).all(axis=1))
    rows = rows[np.lexsort((result.observation_frame[rows], result.observation_point[rows]))]
    if not len(rows):
        return
    points, starts = np.unique(result.observation_point[rows], return_index=True)
    names = result.track_names()
    for point, mine in zip(points.tolist(), np.split(rows, starts[1:]), strict=True):
        numbers = number[result.observation_frame[mine]]
        yield Track(names[point], numbers, xy[mine], flat[mine], result.observation_error[mine])


def _undistorted(camera: pycolmap.Camera, xy: Array) -> Array:
    rays = np.asarray(camera.cam_from_img(xy)).reshape(-1, 2)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    return np.asarray(focal * rays + [camera.principal_point_x, camera.principal_point_y])


def write_csv_tracks(shot: Shot, path: Path) -> None:
    """Write one line per track and frame; pixels from the top left corner, with and without distortion."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["track", "frame", "x", "y", "x_undistorted", "y_undistorted", "error"])
        for track in tracks_of(shot):
            columns = np.column_stack([track.xy, track.undistorted, track.error]).tolist()
            for number, values in zip(track.numbers.tolist(), columns, strict=True):
                writer.writerow([track.name, number, *(f"{value:.6f}" for value in values)])


def write_3de_tracks(shot: Shot, path: Path) -> None:
    """Write 3DEqualizer's text of 2-D tracks: their number, and of each name, colour, length and ``frame x y``.

    Pixels from the bottom left corner, on the footage; frame 1 is the first one of the sequence in 3DEqualizer.
    """
    tracks, height = list(tracks_of(shot)), shot.lens.height
    lines = [str(len(tracks))]
    for track in tracks:
        lines += [track.name, "0", str(len(track.numbers))]
        for number, (x, y) in zip(track.numbers.tolist(), track.xy.tolist(), strict=True):
            lines.append(f"{number} {x:.6f} {height - y:.6f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_nuke_tracks(shot: Shot, path: Path) -> None:
    """Write a script with one Tracker4 node, for the undistorted plate of the format `nuke`.

    Pixels from the bottom left corner. A curve has keys in the frames of its track alone, and the track is enabled
    from its first to its last frame. Signs of a name that Nuke does not take become underscores.
    """
    tracks = list(tracks_of(shot))
    names = _nuke_names([track.name for track in tracks])
    columns = "\n".join(f"{{ {column} }}" for column in _NUKE_COLUMNS)
    rows = "\n".join(_nuke_row(name, track, shot.lens.height) for name, track in zip(names, tracks, strict=True))
    path.write_text(
        f"Tracker4 {{\n inputs 0\n tracks {{ {{ 1 {len(_NUKE_COLUMNS)} {len(tracks)} }}\n{{ {columns}\n}}\n"
        f"{{\n{rows}\n}}\n}}\n name Tracks\n}}\n",
        encoding="utf-8",
    )


def _nuke_names(names: list[str]) -> list[str]:
    """Names that Nuke takes, each once."""
    taken, found = {*names}, []
    for name in names:
        new = _NOT_IN_NUKE.sub("_", name)
        while new != name and new in taken:
            new += "_"
        taken.add(new)
        found.append(new)
    return found


def _nuke_row(name: str, track: Track, height: int) -> str:
    numbers = track.numbers.tolist()
    first, last = numbers[0], numbers[-1]
    curves = [
        " ".join(["curve", *(f"x{number} {value:.6f}" for number, value in zip(numbers, values, strict=True))])
        for values in (track.undistorted[:, 0].tolist(), (height - track.undistorted[:, 1]).tolist())
    ]
    enabled, still = f"{{curve K x{first} 1 x{last + 1} 0}}", f"{{curve K x{first} 0}}"
    empty = " ".join(["{}"] * 11)
    return (
        f'{{ {enabled} "{name}" {{{curves[0]}}} {{{curves[1]}}} {still} {still} 1 0 0 {{curve x{first} 0}} 1 0 '
        f"{_PATTERN} {_SEARCH} {empty} }}"
    )


def write_camera_tracker_tracks(shot: Shot, path: Path) -> None:
    """Write the text in which Nuke's CameraTracker reads tracks, which is Shake's, for the footage as it was shot.

    Pixels from the bottom left corner. The node asks for names of its own, so that those of the tracks are not in it.
    """
    lines, height = [], shot.lens.height
    for k, track in enumerate(tracks_of(shot)):
        lines += [f"TrackName autotrack{k}", "   Frame             X             Y   Correlation"]
        for number, (x, y) in zip(track.numbers.tolist(), track.xy.tolist(), strict=True):
            lines.append(f"{number:.2f} {x:.6f} {height - y:.6f} 1.000")
        lines.append("")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_blender_tracks(shot: Shot, path: Path) -> None:
    """Write a script for Blender that loads the footage as a movie clip and gives it the tracks, as markers.

    Markers lie on the footage, with its distortion, in frames of the clip, whose first one is 1; the clip begins in the
    scene at the number of its first frame. Where there is no footage, the tracks are for the clip that is open.

    Raises:
        InputError: the footage is a folder whose images are not a numbered sequence.
    """
    footage = background(shot)
    file = footage.file(footage.first) if isinstance(footage, Sequence) else footage
    start, size = shot.footage_start, np.array([shot.lens.width, shot.lens.height])
    tracks = []
    for track in tracks_of(shot):
        places = track.xy / size
        places[:, 1] = 1.0 - places[:, 1]
        tracks.append((track.name, (track.numbers - start + 1).tolist(), np.round(places, 9).tolist()))
    data = {"footage": file and file.as_posix(), "frame_start": start, "tracks": tracks}
    text = json.dumps(data, allow_nan=False)
    title = '"""Gives a movie clip in Blender the tracks of a factorsfm reconstruction."""'
    path.write_text(f"{title}\n\nimport json\n\nDATA = json.loads({text!r})\n{_BLENDER}", encoding="utf-8")


def write_after_effects_tracks(shot: Shot, path: Path) -> None:
    """Write a script for After Effects that makes a null with keyframes of each track in the open composition.

    The nulls lie on the footage, with its distortion, as the format `after-effects` places it: with the optical axis
    in the middle of the composition, and square pixels. Times are seconds, of the frames that its keyframes have.
    """
    lens = shot.lens
    middle = np.array([lens.width / 2, lens.height / 2])
    tracks = [
        {
            "name": track.name,
            "times": (track.numbers / shot.fps).tolist(),
            "places": (middle + (track.xy - [lens.cx, lens.cy]) / [1.0, lens.pixel_aspect]).tolist(),
        }
        for track in tracks_of(shot)
    ]
    text = json.dumps({"tracks": tracks}, allow_nan=False)
    path.write_text(f"// Tracks of a factorsfm reconstruction.\nvar DATA = {text};\n{_AFTER_EFFECTS}", encoding="utf-8")
