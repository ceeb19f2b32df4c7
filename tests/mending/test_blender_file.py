"""Tracks of a file of Blender, as Blender itself has saved them."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm import ExportOptions, InputError, Reconstruction, UserTracks, read_tracks
from factorsfm.export import export
from factorsfm.mending.joined import on_footage
from factorsfm.support import blender
from tests.blender_files import in_blender, saved
from tests.exact_result import build
from tests.export_problems import noise_images
from tests.video_files import write_video

NUMBER = 1001  # in the name of the first file of `noise_images`


def with_tracks(folder: Path, result: Reconstruction, script: str = "", first_frame: int | None = None) -> Path:
    """A file of Blender with the clip of `tracks-blender`, and what a further script does to it."""
    footage = noise_images(folder / "shot", 21)
    options = ExportOptions(footage=footage, first_frame=first_frame)
    export(result, folder / "tracks.py", format="tracks-blender", options=options)
    run = f"import runpy; clip = runpy.run_path({str(folder / 'tracks.py')!r})['clip']; tracking = clip.tracking\n"
    return saved(folder, run + script)


def assert_same(read: UserTracks, result: Reconstruction, before: str = "") -> None:
    assert [track.name for track in read.tracks] == [before + name for name in result.track_names()]
    registered = np.array([frame.registered for frame in result.frames])
    for row, track in enumerate(read.tracks):
        mine = (result.observation_point == row) & registered[result.observation_frame]
        assert track.frames.tolist() == [result.frames[k].index for k in result.observation_frame[mine]]
        places = on_footage(track.xy, read, result.camera)
        np.testing.assert_allclose(places, result.observation_xy[mine], atol=1e-3)
        assert track.weight == 1.0


@in_blender
@pytest.mark.parametrize("start", [None, 57])
def test_the_tracks_of_an_export_come_back(start: int | None, tmp_path: Path) -> None:
    result = build()
    path = with_tracks(tmp_path, result, "" if start is None else f"clip.frame_start = {start}")
    read = read_tracks(path, first_frame=NUMBER)
    assert_same(read, result)
    assert (read.size, read.on, read.notes) == ((640, 480), "footage", [])


TO_AN_OBJECT = """
thing = tracking.objects.new("window")
for track in list(tracking.tracks)[KEPT:]:
    other = thing.tracks.new(name=track.name, frame=track.markers[0].frame)
    for marker in track.markers:
        other.markers.insert_frame(marker.frame, co=marker.co).mute = marker.mute
for track in list(tracking.tracks)[KEPT:]:
    for marker in track.markers:
        marker.mute = True
"""


@in_blender
def test_tracks_of_an_object_come_back_where_the_camera_has_none(tmp_path: Path) -> None:
    result = build()
    path = with_tracks(tmp_path, result, TO_AN_OBJECT.replace("KEPT", "0"))
    assert_same(read_tracks(path, first_frame=NUMBER), result, "window ")


@in_blender
def test_tracks_of_an_object_take_no_part_beside_those_of_the_camera(tmp_path: Path) -> None:
    path = with_tracks(tmp_path, build(), TO_AN_OBJECT.replace("KEPT", "4"))
    read = read_tracks(path)
    assert [track.name for track in read.tracks] == build().track_names()[:4]
    assert read.notes == [f"Of tracks {path}, 36 of objects take no part; those of the camera do."]


BY_HAND = """
clip = bpy.data.movieclips.load(FOOTAGE)
clip.frame_start, clip.frame_offset, clip.use_fake_user = 1001, 5, True
corner, lamp, off = (clip.tracking.tracks.new(name=name, frame=1) for name in ("corner", "lamp", "off"))
corner.markers.insert_frame(1, co=(0.25, 0.75))
corner.markers.insert_frame(2, co=(0.5, 0.5))
corner.markers.insert_frame(3, co=(0.5, 0.5)).mute = True
corner.weight, corner.offset = 0.5, (0.125, 0.0)
lamp.markers.insert_frame(1, co=(0.0, 0.0)).mute = True
off.markers.insert_frame(1, co=(0.5, 0.5))
off.weight = 0.0
"""


@in_blender
@pytest.mark.parametrize("movie", [True, False])
def test_what_is_said_of_tracks_in_blender(movie: bool, tmp_path: Path) -> None:
    footage = tmp_path / "shot.mp4"
    images = noise_images(tmp_path / "images", 12)
    write_video(footage, [cv2.imread(str(path)) for path in sorted(images.iterdir())])
    file = footage if movie else images / "shot.1003.png"
    read = read_tracks(saved(tmp_path, BY_HAND.replace("FOOTAGE", repr(str(file)))), first_number=None if movie else 1)
    (corner,) = read.tracks
    assert corner.name == "corner"
    assert corner.frames.tolist() == ([5, 6] if movie else [1008, 1009])
    np.testing.assert_allclose(corner.xy, [[0.375 * 640 - 0.5, 0.25 * 480 - 0.5], [0.625 * 640 - 0.5, 239.5]])
    assert corner.weight == 0.5


TWO_CLIPS = """
for name in ("shot.1001.png", "shot.1002.png"):
    clip = bpy.data.movieclips.load(FOLDER + "/" + name)
    clip.use_fake_user = True
    clip.tracking.tracks.new(name=name[5:9], frame=1).markers.insert_frame(1, co=(0.5, 0.5))
bpy.data.movieclips.load(FOLDER + "/shot.1003.png")
"""


@in_blender
def test_of_several_clips_the_active_one_is_read(tmp_path: Path) -> None:
    script = TWO_CLIPS.replace("FOLDER", repr(str(noise_images(tmp_path / "shot", 3))))
    words = (
        r"2 movie clips have tracks, shot\.1001\.png, shot\.1002\.png; one is expected, or one of them as the active"
    )
    with pytest.raises(InputError, match=words):
        read_tracks(saved(tmp_path, script))
    active = "bpy.context.scene.active_clip = bpy.data.movieclips['shot.1002.png']\n"
    (track,) = read_tracks(saved(tmp_path, script + active)).tracks
    assert track.name == "1002"


@in_blender
def test_files_of_blender_that_hold_no_tracks(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"shot\.blend: no movie clip has tracks; save the file in Blender"):
        read_tracks(saved(tmp_path, ""))
    for content in (b"", b"track,frame,x,y\n", b"BLENDER-v304" + bytes(1000)):
        (tmp_path / "other.blend").write_bytes(content)
        with pytest.raises(InputError, match=r"Blender cannot open other\.blend"):
            read_tracks(tmp_path / "other.blend")


def test_a_file_that_is_not_there_and_a_blender_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"away\.blend: there is no such file"):
        read_tracks(tmp_path / "away.blend")
    (tmp_path / "shot.blend").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"is opened by Blender; the program blender is expected in the PATH"):
        read_tracks(tmp_path / "shot.blend")


def test_a_blender_that_does_not_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "blender").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "blender").chmod(0o755)
    (tmp_path / "shot.blend").touch()
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(blender, "_SECONDS", 0.5)
    with pytest.raises(InputError, match=r"Blender has not opened shot\.blend in 0\.5 seconds"):
        read_tracks(tmp_path / "shot.blend")
