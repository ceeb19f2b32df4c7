"""The tracks of a movie clip in a file of Blender, which Blender itself reads."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.blender import found_in_blender
from factorsfm.support.errors import InputError
from factorsfm.support.first_few import first_few

Array = NDArray[np.float64]

# A solve of Blender takes a marker with the offset of its track, too. `frame_offset` says which frame
# of the footage frame 1 of the clip is.
_SCRIPT = """
found = []
for clip in bpy.data.movieclips:
    objects = []
    for object in clip.tracking.objects:
        tracks = []
        for track in object.tracks:
            x, y = track.offset
            markers = [(m.frame + clip.frame_offset, m.co[0] + x, m.co[1] + y) for m in track.markers if not m.mute]
            if markers and track.weight >= 0.001:
                tracks.append((track.name, track.weight, markers))
        if tracks:
            objects.append({"name": object.name, "camera": object.is_camera, "tracks": tracks})
    active = any(scene.active_clip == clip for scene in bpy.data.scenes)
    found.append({
        "name": clip.name, "file": clip.filepath, "movie": clip.source == "MOVIE", "size": list(clip.size),
        "active": active, "objects": objects,
    })
"""


@dataclass(frozen=True, slots=True)
class ClipTrack:
    """A track of a clip.

    Attributes:
        name: of a track of an object with that of the object before it.
        weight: that it has in Blender; one without is left out.
        frames: (k,) of a movie from 1 on, of a sequence their numbers.
        xy: (k, 2) pixels from the top left corner of the footage.
    """

    name: str
    weight: float
    frames: NDArray[np.int64]
    xy: Array


@dataclass(frozen=True, slots=True)
class ClipTracks:
    """The tracks of a clip.

    Attributes:
        tracks: those of the camera; of the objects, where it has none.
        size: width and height of the footage, pixels.
        notes: what is left out, in sentences.
    """

    tracks: list[ClipTrack]
    size: tuple[int, int]
    notes: list[str]


def blender_tracks(path: Path) -> ClipTracks:
    """Read the tracks of the one movie clip that has some, or of the scene's active one; without disabled markers.

    Raises:
        InputError: Blender is not there or cannot read the file, or no clip or several ones have tracks.
    """
    clips = [clip for clip in found_in_blender(path, _SCRIPT) if clip["objects"]]
    if len(clips) > 1:
        clips = [clip for clip in clips if clip["active"]] or clips
    if not clips:
        raise InputError("no movie clip has tracks; save the file in Blender after tracking")
    if len(clips) > 1:
        names = first_few([clip["name"] for clip in clips], 5)
        raise InputError(
            f"{len(clips)} movie clips have tracks, {names}; one is expected, or one of them as the "
            "active clip of the scene"
        )
    clip = clips[0]
    if min(clip["size"]) < 1:
        raise InputError(f"the size of the clip {clip['name']} is not known; its footage is expected")
    return _tracks_of(clip, path)


def _tracks_of(clip: dict[str, Any], path: Path) -> ClipTracks:
    size = np.array(clip["size"], np.float64)
    of_camera = [thing for thing in clip["objects"] if thing["camera"]]
    number = re.search(r"(\d+)\D*$", PurePath(clip["file"]).stem)
    before = int(number[1]) - 1 if number and not clip["movie"] else 0  # number of the frame before the clip's first
    tracks = []
    for thing in of_camera or clip["objects"]:
        for name, weight, markers in thing["tracks"]:
            rows = np.array(markers, np.float64)
            xy = np.column_stack([rows[:, 1], 1.0 - rows[:, 2]]) * size
            name = name if thing["camera"] else f"{thing['name']} {name}"
            tracks.append(ClipTrack(name, weight, rows[:, 0].astype(np.int64) + before, xy))
    notes = []
    if of_camera and (count := sum(len(thing["tracks"]) for thing in clip["objects"] if not thing["camera"])):
        notes.append(f"Of tracks {path}, {count} of objects take no part; those of the camera do.")
    return ClipTracks(tracks, (int(size[0]), int(size[1])), notes)
