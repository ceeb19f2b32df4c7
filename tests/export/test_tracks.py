"""2-D tracks read back frame by frame, in the conventions of each program."""

import csv
import json
import re
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorsfm.export import ExportOptions, export
from factorsfm.mending.user_tracks import read_tracks
from factorsfm.result.reconstruction import Reconstruction
from tests.exact_result import build
from tests.export_problems import noise_images
from tests.exported_files import after_effects_tracks

FIRST = 1001
HEIGHT, WIDTH = 480, 640


def expected() -> dict[tuple[str, int], np.ndarray]:
    """Pixels from the top left corner by track and number of the frame: raw x, y and x, y of the pinhole."""
    result = build()
    found = {}
    for position, point, xy in zip(
        result.observation_frame.tolist(), result.observation_point.tolist(), result.observation_xy, strict=True
    ):
        frame = result.frames[position]
        if frame.cam_from_world is not None:
            x, y, z = frame.cam_from_world * result.points[point]
            flat = [500 * x / z + 321, 510 * y / z + 239]
            found[f"track_{result.track_ids[point] + 1:05d}", FIRST + frame.index] = np.array([*(xy + 0.5), *flat])
    return found


def compare(found: dict[tuple[str, int], Any], part: slice, tolerance: float = 2e-6) -> None:
    truth = expected()
    assert found.keys() == truth.keys()
    for key, place in found.items():
        np.testing.assert_allclose(place, truth[key][part], atol=tolerance)


def written(folder: Path, format: str, **options: Any) -> str:
    export(build(), folder / "out", format=format, options=ExportOptions(first_frame=FIRST, **options))
    return (folder / "out").read_text()


def test_csv(tmp_path: Path) -> None:
    rows = list(csv.DictReader(written(tmp_path, "tracks-csv").splitlines()))
    columns = ("x", "y", "x_undistorted", "y_undistorted")
    compare({(r["track"], int(r["frame"])): [float(r[c]) for c in columns] for r in rows}, slice(4), 1e-5)


def test_3de(tmp_path: Path) -> None:
    lines = iter(written(tmp_path, "tracks-3de").splitlines())
    found = {}
    for _ in range(int(next(lines))):
        name, color, count = next(lines), next(lines), int(next(lines))
        assert color == "0"
        for _ in range(count):
            number, x, y = next(lines).split()
            found[name, int(number)] = [float(x), HEIGHT - float(y)]
    assert next(lines, None) is None
    compare(found, slice(2))


def test_camera_tracker(tmp_path: Path) -> None:
    found = {}
    for k, block in enumerate(written(tmp_path, "tracks-camera-tracker").split("TrackName ")[1:]):
        name, heading, *places = block.splitlines()
        assert name == f"autotrack{k}"
        assert heading.split() == ["Frame", "X", "Y", "Correlation"]
        for place in filter(None, places):
            number, x, y, correlation = map(float, place.split())
            assert correlation == 1.0
            found[build().track_names()[k], int(number)] = [x, HEIGHT - y]
    compare(found, slice(2))


def test_nuke_tracks_lie_on_the_undistorted_plate(tmp_path: Path) -> None:
    text = written(tmp_path, "tracks-nuke")
    assert text.count("{") == text.count("}")
    columns, tracks = re.findall(r"tracks \{ \{ 1 (\d+) (\d+) \}", text)[0]
    assert (columns, tracks) == ("31", "40")
    assert (
        len(re.findall(r"^\{?\s*\{ \d 1? ?\d+ \w+ \w+ 1 \}|^\{ \{? ?\d \d \d+ \w+ \w+ 1 \}", text, re.MULTILINE)) == 31
    )
    found = {}
    for name, x, y in re.findall(r'\} "(\w+)" \{curve ([^}]*)\} \{curve ([^}]*)\}', text):
        for (number, value), (same, other) in zip(
            re.findall(r"x(\d+) (\S+)", x), re.findall(r"x(\d+) (\S+)", y), strict=True
        ):
            assert number == same
            found[name, int(number)] = [float(value), HEIGHT - float(other)]
    compare(found, slice(2, 4), 1e-5)


def test_nuke_tracks_keep_different_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where they differ in signs alone that Nuke does not take."""
    others = [f"other {k}" for k in range(35)]
    monkeypatch.setattr(Reconstruction, "track_names", lambda _: ["a[1]", "a{1}", "a_1_", "$", "b c", *others])
    written(tmp_path, "tracks-nuke")
    found = read_tracks(tmp_path / "out", first_frame=FIRST).tracks
    assert [track.name for track in found] == ["a_1__", "a_1___", "a_1_", "_", "b c", *others]
    truth = expected()
    for number, track in enumerate(found, 101):
        flat = [truth[f"track_{number:05d}", FIRST + frame][2:] for frame in track.frames.tolist()]
        np.testing.assert_allclose(track.xy * [1, -1] + [0.5, HEIGHT], flat, atol=1e-5)


def test_after_effects(tmp_path: Path) -> None:
    text = written(tmp_path, "tracks-after-effects", fps=25)
    data = json.loads(re.findall(r"var DATA = (.*);\n", text)[0])
    found = {}
    for track in data["tracks"]:
        for time, (x, y) in zip(track["times"], track["places"], strict=True):
            # As its footage is placed: the optical axis in the middle, pixels square.
            place = [x - WIDTH / 2 + 321, (y - HEIGHT / 2) * 510 / 500 + 239]
            found[track["name"], round(25 * time)] = place
    compare(found, slice(2))


@pytest.mark.parametrize("first_frame", [None, 0, 86400])
def test_after_effects_has_camera_and_tracks_at_the_same_times(tmp_path: Path, first_frame: int | None) -> None:
    """Also of a numbered sequence, which both count from the start of the composition."""
    result = build()
    frames = [replace(frame, index=1001 + k) for k, frame in enumerate(result.frames)]
    result = replace(result, frames=frames, options={"first_number": 1001})
    options = ExportOptions(first_frame=first_frame, fps=25)
    export(result, tmp_path / "camera", format="after-effects", options=options)
    export(result, tmp_path / "tracks.jsx", format="tracks-after-effects", options=options)
    _, camera = after_effects_tracks((tmp_path / "camera" / "camera.txt").read_text())
    keys = list(camera["Transform\tPosition"])
    assert keys == [(first_frame or 0) + k for k in (0, 1, 2, 4, 5)]
    for track in json.loads(re.findall(r"var DATA = (.*);\n", (tmp_path / "tracks.jsx").read_text())[0])["tracks"]:
        np.testing.assert_allclose(track["times"], np.array(keys) / 25, rtol=1e-12)


def test_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script with a stand-in for Blender that keeps its markers."""
    footage = noise_images(tmp_path / "shot", 21)
    script = written(tmp_path, "tracks-blender", footage=footage)
    markers: dict[str, dict[int, Any]] = {}

    def new(name: str, frame: int) -> Any:
        mine = markers.setdefault(name, {})

        def insert(at: int, co: Any) -> Any:
            mine[at] = types.SimpleNamespace(co=co, mute=False)
            return mine[at]

        return types.SimpleNamespace(markers=types.SimpleNamespace(insert_frame=insert))

    clip = types.SimpleNamespace(tracking=types.SimpleNamespace(tracks=types.SimpleNamespace(new=new)))
    data = types.SimpleNamespace(movieclips=types.SimpleNamespace(load=lambda path: clip))
    context = types.SimpleNamespace(scene=types.SimpleNamespace())
    monkeypatch.setitem(__import__("sys").modules, "bpy", types.SimpleNamespace(data=data, context=context))
    exec(compile(script, "tracks.py", "exec"), {})
    assert context.scene.active_clip is clip
    assert clip.frame_start == FIRST  # where frame 1 of the clip is shown
    found = {
        (name, clip.frame_start - 1 + number): [marker.co[0] * WIDTH, (1 - marker.co[1]) * HEIGHT]
        for name, mine in markers.items()
        for number, marker in mine.items()
        if not marker.mute
    }
    compare(found, slice(2))
