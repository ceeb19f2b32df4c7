"""Tracks of the user: read as they were written, and solved with their own weight, named, never lost without a word."""

import csv
import json
import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorsfm import (
    ExportOptions,
    InputError,
    Options,
    Reconstruction,
    Stream,
    UserTrack,
    UserTracks,
    read_result,
    read_tracks,
    reconstruct,
    solve_again,
)
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.track_errors import measure_track_errors
from factorsfm.cli.main import main
from factorsfm.export import export
from factorsfm.mending.joined import joined, on_footage
from tests.command_line import assert_error
from tests.exact_result import build
from tests.exported_files import after_effects_tracks, nuke_curves, nuke_nodes
from tests.rendered import FRAMES, rendered, with_fewer_tracks
from tests.report.chromium import EXECUTABLE, MISSING, Chromium

TRACK_FILES = ("tracks-csv", "tracks-nuke", "tracks-camera-tracker", "tracks-3de")


@pytest.mark.parametrize("format", TRACK_FILES)
@pytest.mark.parametrize("first_frame", [None, 77])
def test_what_export_writes_is_read_back(format: str, first_frame: int | None, tmp_path: Path) -> None:
    result = build()
    export(result, tmp_path / "tracks", format=format, options=ExportOptions(first_frame=first_frame))
    read = read_tracks(tmp_path / "tracks", first_frame=first_frame)
    names = result.track_names()
    if format == "tracks-camera-tracker":  # it has names of its own
        names = [f"autotrack{k}" for k in range(len(names))]
    assert [track.name for track in read.tracks] == names
    registered = [frame.registered for frame in result.frames]
    for row, track in enumerate(read.tracks):
        mine = (result.observation_point == row) & np.array(registered)[result.observation_frame]
        assert track.frames.tolist() == [result.frames[k].index for k in result.observation_frame[mine]]
        places = on_footage(track.xy, read, result.camera)
        np.testing.assert_allclose(places, result.observation_xy[mine], atol=3e-6)


def test_a_numbered_sequence_keeps_its_numbers(tmp_path: Path) -> None:
    result = build()
    result.options["first_number"] = 10
    for format in TRACK_FILES:
        export(result, tmp_path / format, format=format)
        assert read_tracks(tmp_path / format, first_number=10).tracks[0].frames.tolist() == [10, 12, 14, 18, 20]


AFTER_EFFECTS = "\r\n".join(
    [
        "Adobe After Effects 8.0 Keyframe Data", "", "\tUnits Per Second\t25", "\tSource Width\t1920", "",
        "Motion Trackers\tTracker #1\tTrack Point #2\tFeature Center", "\tFrame\tX pixels\tY pixels\t",
        "\t3\t100.5\t20.25\t", "\t4\t101\t21\t", "",
        "Motion Trackers\tTracker #1\tTrack Point #2\tConfidence", "\tFrame\tpercent\t", "\t3\t99\t", "",
        "Transform\tScale", "\tFrame\tX percent\tY percent\t", "\t0\t100\t100\t", "",
        "Transform\tPosition", "\tFrame\tX pixels\tY pixels\tZ pixels\t", "\t0\t7\t8\t0\t", "",
        "End of Keyframe Data", "",
    ]
)  # fmt: skip


def test_keyframes_that_after_effects_copies(tmp_path: Path) -> None:
    (tmp_path / "ae.txt").write_bytes(AFTER_EFFECTS.encode())
    point, layer = read_tracks(tmp_path / "ae.txt", first_frame=1).tracks
    assert (point.name, layer.name) == ("Tracker #1 Track Point #2", "position 2")
    assert (point.frames.tolist(), layer.frames.tolist()) == ([2, 3], [-1])
    np.testing.assert_allclose(point.xy, [[100.0, 19.75], [100.5, 20.5]])
    assert not read_tracks(tmp_path / "ae.txt").from_bottom


@pytest.mark.parametrize(("sizes", "expected"), [("\tSource Height\t1080\r\n", (1920, 1080)), ("", None)])
def test_after_effects_says_the_size_of_the_footage_but_not_of_a_composition(
    sizes: str, expected: tuple[int, int] | None, tmp_path: Path
) -> None:
    said = AFTER_EFFECTS.replace("\t1920\r\n", f"\t1920\r\n{sizes}")
    (tmp_path / "ae.txt").write_bytes(said.encode())
    assert read_tracks(tmp_path / "ae.txt").size == expected
    (tmp_path / "ae.txt").write_bytes(said.replace("Feature Center", "Confidence").encode())
    assert read_tracks(tmp_path / "ae.txt").size is None  # that of the layer whose position it is


NUKE = """
Read { name Read1 }
Tracker4 {
 tracks { { 1 31 2 }
{ { 5 1 20 enable e 1 }
{ 3 1 75 name name 1 }
{ 2 1 58 track_x track_x 1 }
{ 2 1 58 track_y track_y 1 } }
{ { {curve K x1001 1} "door \\"knob\\"" {curve x1001 10 11.5 x1005 13 i} {curve x1001 L 20 20.25 x1005 21} }
 { {curve K x1001 1} lamp {curve} {curve} } }
}
 name Tracker1
}
"""


def test_a_script_of_nuke(tmp_path: Path) -> None:
    (tmp_path / "shot.nk").write_text(NUKE)
    read = read_tracks(tmp_path / "shot.nk", on="footage")
    (track,) = read.tracks  # the other one has no keys
    assert (track.name, track.frames.tolist(), read.on) == ('door "knob"', [0, 1, 4], "footage")
    camera = build().camera
    np.testing.assert_allclose(on_footage(track.xy, read, camera), [[9.5, 459.5], [11.0, 459.25], [12.5, 458.5]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "neither a table"),
        ("hello world\n", "neither a table"),
        ("name,frame,x,y\na,1,2,3\n", "no column track"),
        ("track,frame,x,y\n", "there is no track"),
        (
            'track,frame,x,y\na,0,1,2\n"a,1,1,2\na,2,1,2\n',
            "after line 2 a row does not end, as where a quote is",
        ),
        (
            'track,frame,x,y\na,0,1,2\n"a,1,1,2\n' + 20000 * "a,2,1,2\n",
            "after line 2 a row does not end, as where a quote",
        ),
        ('"track,frame,x,y\n' + 20000 * "a,2,1,2\n", "after line 0 a row does not end, as where a quote is not closed"),
        ("track,frame,x,y\na,1,2\n", "line 2 is '1', '2', None"),
        ("track,frame,x,y\na,1.5,2,3\n", "line 2 is '1.5'"),
        ("track,frame,x,y\na,1,2,nan\n", "is none"),
        ("track,frame,x,y\na,1,2,3\na,1,2,3\n", 'track "a" has frame 1 twice'),
        ("track,frame,x,y\n ,1,2,3\n", "a name in one line"),
        ("2\na\n0\n1\n1 2 3\n", "the text ends before its last track"),
        ("1\na\n0\n1\n1 2\n", "a line of track \"a\" is '1', '2', ''; a frame and two numbers are expected"),
        ("1\na\n0\nmany\n1 2 3\n", '"many" is no number of places of track "a"'),
        ("TrackName a\n Frame X Y Correlation\n1.00 2 3 1\n1.00 2 3 1\n", 'track "a" has frame 1 twice'),
        ("TrackName a\n1.00 2 3 1\nTrackName a\n2.00 2 3 1\n", 'track "a" is there twice'),
        ("TrackName a\n1.50 2 3 1\n", "line 2 is '1.50'"),
        (AFTER_EFFECTS.replace("101\t21", "101"), "line 9 is '4', '101', ''"),
        (AFTER_EFFECTS[:40], "there is no track"),
        ("TrackName a\n1.00 2\n", "line 2 is '1', '2', ''"),
        ("Tracker4 {\n tracks { { 1 2 3 }\n", "not closed"),
        ("Tracker4 {\n name a\n}\n", "no table of tracks"),
        (NUKE.replace("track_y track_y", "y y"), "no column track_y"),
        (NUKE.replace("curve x1001 10 11.5", "curve {parent.x}"), "an expression"),
    ],
)
def test_files_that_cannot_be_read(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "tracks.txt").write_text(text)
    with pytest.raises(InputError, match=f"tracks.txt.*{words}"):
        read_tracks(tmp_path / "tracks.txt")


def test_a_file_that_is_no_text_is_told_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "shot.mp4").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"shot\.mp4: neither a table.* nor a \.blend file"):
        read_tracks(tmp_path / "shot.mp4")


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (lambda: UserTracks([]), "there is no track"),
        (lambda: UserTracks([a_track(), a_track()]), "there twice"),
        (lambda: UserTracks([a_track()], sigma=0.0), "standard deviation of the tracks is 0"),
        (lambda: UserTracks([a_track()], on="plate"), 'lie on "plate"'),
        (lambda: a_track(frames=[2, 1]), "do not ascend"),
        (lambda: replace(a_track(), weight=0.0), 'the weight of track "a" is 0; 0.001 to 1000 is expected'),
        (lambda: a_track(frames=[1]), "of shape"),
        (lambda: a_track(frames=[1, 2.5]), 'track "a" has a place or a frame that is none'),
        (lambda: a_track(frames=[1, math.nan]), 'track "a" has a place or a frame that is none'),
        (lambda: a_track(frames=["one", "two"]), 'track "a" has frames or places that are no numbers'),
        (lambda: UserTrack("a", [0, 1], [[1.0, 2.0], [3.0]]), 'track "a" has frames or places that are no numbers'),
        (lambda: UserTrack(7, [0], [[1.0, 2.0]]), "a track is called 7; a name in one line is expected"),
    ],
)
def test_tracks_that_are_none(tracks: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        tracks()


def test_lists_do_for_a_track() -> None:
    track, same = UserTrack("a", [0, 1], [[10, 20], [11, 21]]), a_track()
    for given, expected in ((track.frames, same.frames), (track.xy, same.xy)):
        assert given.dtype == expected.dtype
        np.testing.assert_array_equal(given, expected)


def test_a_file_has_no_half_frames(tmp_path: Path) -> None:
    (tmp_path / "tracks.csv").write_text("track,frame,x,y\na,1,2,3\n")
    with pytest.raises(InputError, match=r"first_frame is 10\.5; a whole number is expected"):
        read_tracks(tmp_path / "tracks.csv", first_frame=10.5)


def a_track(frames: Sequence[Any] = (0, 1)) -> UserTrack:
    return UserTrack("a", np.array(frames), np.array([[10.0, 20.0], [11.0, 21.0]]))


def test_known_errors_are_white_and_say_nothing_of_the_others() -> None:
    rng = np.random.default_rng(0)
    point, frame = np.repeat(np.arange(40), 20), np.tile(np.arange(20), 40)
    observations = Observations(frame, point, np.zeros((800, 2)))
    residual = rng.normal(0, 0.1, (800, 2)) + np.repeat(rng.normal(0, 0.1, (40, 2)), 20, axis=0)
    alone = measure_track_errors(residual[:600], observations.of(np.arange(30)), 2.0)
    residual[600:] = 50.0 * rng.normal(0, 0.1, (200, 2))
    sigma = np.where(np.arange(40) < 30, np.nan, 5.0)
    found = measure_track_errors(residual, observations, 2.0, sigma)
    assert found.sigma == alone.sigma
    np.testing.assert_array_equal(found.root_weight[:600], alone.root_weight)
    np.testing.assert_array_equal(found.persistent, [*alone.persistent, *np.zeros(10)])
    assert np.median(found.sigma / found.root_weight[600:]) == pytest.approx(5.0, rel=0.25)
    assert (found.sigma / found.root_weight[600:]).min() >= 5.0


# --- in a solve ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    shot = rendered("dolly")
    with Stream(shot.camera, options=with_fewer_tracks(Options())) as stream:
        for image in shot.images:
            stream.push(image)
        return stream.finish()


NAMES = [f"window {k}" for k in range(6)]


@pytest.fixture(scope="module")
def tracks(result: Reconstruction) -> UserTracks:
    """Of six points of the result with noise of 0.3 pixels, and two that slide by 12 pixels."""
    rng, chosen = np.random.default_rng(1), np.linspace(0, len(result.points) - 1, 8).astype(int)
    found = []
    for name, row in zip([*NAMES, "slides", "slips"], chosen.tolist(), strict=True):
        seen = [result.camera.img_from_cam(f.cam_from_world * result.points[row]) - 0.5 for f in result.frames]
        xy = np.array(seen) + rng.normal(0, 0.3, (FRAMES, 2))
        if name not in NAMES:
            xy += np.outer(np.sin(np.linspace(0, 3, FRAMES)), rng.choice([-12, 12], 2))
        found.append(UserTrack(name, np.arange(FRAMES), xy))
    return UserTracks(found, sigma=0.3)


def test_a_weight_divides_the_standard_deviation_and_notes_of_a_file_are_kept(
    result: Reconstruction, tracks: UserTracks
) -> None:
    assert result.measured is not None
    weighed = [replace(track, weight=weight) for track, weight in zip(tracks.tracks[:2], (0.5, 2.0), strict=True)]
    found = joined(result.measured, UserTracks(weighed, sigma=0.3, notes=["One is left out."]))
    assert found.supervised.sigma.tolist() == [0.6, 0.15]
    assert found.notes[-1] == "One is left out."


def write_table(tracks: UserTracks, path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["track", "frame", "x", "y"])
        for track in tracks.tracks:
            writer.writerows([track.name, f, *(xy + 0.5)] for f, xy in zip(track.frames, track.xy, strict=True))


@pytest.fixture(scope="module")
def solved(result: Reconstruction, tracks: UserTracks, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracks")
    result.write(folder / "result")
    write_table(tracks, folder / "tracks.csv")
    command = ["solve", str(folder / "result"), "--tracks", str(folder / "tracks.csv"), "--tracks-sigma", "0.3"]
    assert main([*command, "--output", str(folder / "solved")]) == 0
    return folder / "solved"


def test_supervised_tracks_become_named_points(result: Reconstruction, solved: Path, tmp_path: Path) -> None:
    found = read_result(solved)
    summary = json.loads((solved / "summary.json").read_text())
    points = {point["name"]: point for point in summary["named_points"]}
    assert list(points) == [*NAMES, "slides", "slips"]
    chosen = np.linspace(0, len(result.points) - 1, 8).astype(int)
    for name, row in zip(NAMES, chosen, strict=False):
        assert points[name]["error"] == pytest.approx(0.3, rel=0.5)
        place, known = np.array(points[name]["position"]), result.points[row]
        pixels = [result.camera.img_from_cam(result.frames[4].cam_from_world * point) for point in (place, known)]
        assert np.linalg.norm(pixels[0] - pixels[1]) < 0.5
        assert place[2] == pytest.approx(known[2], rel=0.1)
        assert not points[name]["contradicts"]
    for name in ("slides", "slips"):
        assert points[name]["contradicts"]
        assert points[name]["error"] > 2.0
    assert set(points) <= set(found.track_names())
    export(found, tmp_path / "tracks", format="tracks-3de")
    assert {track.name for track in read_tracks(tmp_path / "tracks").tracks} >= set(points)
    worst, next_worst = sorted(("slides", "slips"), key=lambda name: -points[name]["error"])
    assert found.notes[-1] == (
        f"Supervised tracks that contradict the others and hardly count: 2 of 8; {worst} "
        f"({points[worst]['error']:.1f} px), {next_worst} ({points[next_worst]['error']:.1f} px)."
    )
    for frame, other in zip(found.frames, result.frames, strict=True):
        np.testing.assert_allclose(frame.cam_from_world.matrix(), other.cam_from_world.matrix(), atol=2e-3)


def test_named_points_are_nulls(solved: Path, tmp_path: Path) -> None:
    found, points = read_result(solved), json.loads((solved / "summary.json").read_text())["named_points"]
    x, y, z = next(point["position"] for point in points if point["name"] == "window 2")
    names = {"nuke": "nuke", "blender": "scene.py", "usd": "a.usda", "after-effects": "ae", "alembic": "a.abc"}
    for format, name in names.items():
        export(found, tmp_path / name, format=format, options=ExportOptions(scale=2.0))
    script = (tmp_path / "nuke" / "camera.nk").read_text()
    assert "AllPoints" not in script
    moved = nuke_curves(nuke_nodes(script)["point_window_2"]["translate"])
    np.testing.assert_allclose(moved[1001], [2 * x, -2 * y, -2 * z], rtol=1e-9)
    assert not (tmp_path / "nuke" / "point_window_2.obj").exists()
    nulls = json.loads(eval(re.findall(r"json.loads\((.*)\)\n", (tmp_path / "scene.py").read_text())[0]))["objects"]
    (null,) = (null for null in nulls if null["name"] == "point_window_2")
    np.testing.assert_allclose(null["locations"], [[2 * x, 2 * z, -2 * y]], rtol=1e-9)
    _, keys = after_effects_tracks((tmp_path / "ae" / "point_window_2.txt").read_text())
    np.testing.assert_allclose(keys["Transform\tPosition"][0], [2 * x + 160, 2 * y + 90, 2 * z], rtol=1e-9)
    usd = pytest.importorskip("pxr.Usd")
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/factorsfm/point_window_2")
    translation = prim.GetAttribute("xformOp:transform").Get(1001).ExtractTranslation()
    np.testing.assert_allclose(translation, [2 * x, -2 * y, -2 * z], rtol=1e-9)
    assert not prim.GetChildren()


def test_a_scene_is_aligned_at_them(solved: Path, tmp_path: Path) -> None:
    picks = ["--origin", NAMES[1], "--axis", NAMES[4], "--distance", NAMES[1], NAMES[4], "2"]
    assert main(["align", str(solved), *picks, "--output", str(tmp_path / "aligned")]) == 0
    places = {
        p["name"]: p["position"] for p in json.loads((tmp_path / "aligned/summary.json").read_text())["named_points"]
    }
    np.testing.assert_allclose(places[NAMES[1]], 0, atol=1e-6)
    assert np.linalg.norm(places[NAMES[4]]) == pytest.approx(2.0, abs=1e-6)
    assert places[NAMES[4]][2] == pytest.approx(0.0, abs=1e-6)


def test_survey_names_them(result: Reconstruction, tracks: UserTracks, tmp_path: Path) -> None:
    rows = np.linspace(0, len(result.points) - 1, 8).astype(int)
    surveyed = dict(zip(NAMES[:5], (2.0 * result.points[rows] + [1.0, -2.0, 3.0])[:5].tolist(), strict=True))
    points = [{"name": name, "position": place, "sigma": 0.005} for name, place in surveyed.items()]
    distance = {"points": NAMES[4:6], "length": 1.0, "sigma": 100.0}
    write_table(tracks, tmp_path / "tracks.csv")
    (tmp_path / "survey.json").write_text(
        json.dumps({"points": [*points, {"name": NAMES[5]}], "distances": [distance]})
    )
    options = {"control": tmp_path / "survey.json", "tracks": tmp_path / "tracks.csv"}
    found = solve_again(result, **options)
    assert found.metric
    places = dict(zip(found.track_names(), found.points, strict=True))
    for name, place in surveyed.items():
        assert 0 < np.linalg.norm(places[name] - place) < 0.3  # seen by the images alone
    assert found.control is not None
    errors = {item.name: item.error for item in found.control.residuals}
    assert max(errors[f"point {name}"] for name in surveyed) < 0.01
    assert f"point {NAMES[5]}" not in errors
    assert sum(name.startswith(f"point {NAMES[5]} in ") for name in errors) == FRAMES
    paths = [np.linalg.norm(np.ptp(r.camera_centers(), axis=0)) for r in (result, found)]
    assert paths[1] == pytest.approx(2.0 * paths[0], rel=0.1)
    found.write(tmp_path / "found")  # and the file of the tracks keeps it
    again = solve_again(tmp_path / "found")
    np.testing.assert_allclose(again.camera_centers(), found.camera_centers(), atol=1e-3)
    fewer = solve_again(tmp_path / "found", without_tracks=[NAMES[1], NAMES[5]])  # and what is known of them
    assert fewer.control is not None
    left = {item.name.removeprefix("point ").partition(" in ")[0] for item in fewer.control.residuals}
    assert left == {NAMES[0], *NAMES[2:5]}
    with pytest.raises(InputError, match="positions"):
        solve_again(tmp_path / "found", without_tracks=NAMES[1:5])
    words = f'control: point {NAMES[0]} has no "pixels", and no track of this name is given'
    with pytest.raises(InputError, match=words):
        solve_again(result, control=tmp_path / "survey.json")


def test_they_are_left_out_by_their_names_and_numbers(solved: Path, tmp_path: Path) -> None:
    number = next(
        p["track"] for p in json.loads((solved / "summary.json").read_text())["named_points"] if p["name"] == "slips"
    )
    out = ["--output", str(tmp_path / "mended")]
    assert main(["solve", str(solved), "--without-tracks", "slides", str(number), *out]) == 0
    found = read_result(tmp_path / "mended")
    assert [name for name in found.track_names() if not name.startswith("track_")] == NAMES
    assert found.notes == ["Solved again without 2 tracks: slides, slips."]


@pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)
def test_the_report_finds_the_wrong_ones_and_its_command_leaves_them_out(solved: Path, tmp_path: Path) -> None:
    browser = Chromium(tmp_path / "profile")
    browser.open(solved / "report.html")
    named = browser.run("[...byId('tracks_rows').rows].slice(0, 2).map(row => row.cells[1].textContent)")
    browser.run("[...byId('tracks_rows').rows].slice(0, 2).forEach(row => row.querySelector('input').click())")
    command = shlex.split(browser.run("byId('mend_command').value"))
    browser.close()
    assert {*named} == {"slides", "slips"}
    assert command[-2:] == ["--output", f"{solved}-mended"]
    assert main(command[1:]) == 0
    assert read_result(f"{solved}-mended").notes == ["Solved again without 2 tracks: slides, slips."]


@pytest.fixture(scope="module")
def numbered(result: Reconstruction, tracks: UserTracks) -> tuple[Reconstruction, int]:
    """Solved with a track that the user calls by the number of another one, and that number."""
    number = int(result.track_ids[0]) + 1
    own = UserTrack(str(number), tracks.tracks[0].frames, tracks.tracks[0].xy)
    return solve_again(result, tracks=UserTracks([own], sigma=0.3)), number


def test_a_name_comes_before_a_number(numbered: tuple[Reconstruction, int]) -> None:
    solved, number = numbered
    own, other = str(number), f"track_{number:05d}"
    assert {own, other} < {*solved.track_names()}
    for given, gone, stays in ((own, own, other), (other, other, own), (number, other, own)):
        again = solve_again(solved, without_tracks=[given])
        assert gone not in again.track_names()
        assert stays in again.track_names()
        assert again.notes[-1] == f"Solved again without 1 track: {gone}."
        assert again.options["solved_again"][-1]["without_tracks"] == [str(given)]


@pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)
@pytest.mark.parametrize("own", [True, False])
def test_the_command_of_the_report_tells_a_number_from_a_name(
    own: bool, numbered: tuple[Reconstruction, int], tmp_path: Path
) -> None:
    solved, number = numbered
    row = solved.track_ids.tolist().index(number - 1)
    solved.observation_error = np.where(solved.observation_point == row, 50.0, solved.observation_error)  # is listed
    solved.write(tmp_path / "result")
    browser = Chromium(tmp_path / "profile")
    browser.open(tmp_path / "result" / "report.html")
    name = str(number) if own else f"track_{number:05d}"
    listed = f"[...byId('tracks_rows').rows].find(row => row.cells[1].textContent === '{name}')"
    browser.run(f"{listed}.querySelector('input').click()")
    command = shlex.split(browser.run("byId('mend_command').value"))
    browser.close()
    assert main(command[1:]) == 0
    assert read_result(f"{tmp_path / 'result'}-mended").notes[-1] == f"Solved again without 1 track: {name}."


def test_a_track_that_cannot_be_placed_is_named(result: Reconstruction, tracks: UserTracks) -> None:
    first, second = tracks.tracks[:2]
    once = UserTrack("window 9", np.array([0, 90, 91]), np.array([[5.0, 5.0]] * 3))
    never = UserTrack("window 10", np.array([90, 91]), np.array([[5.0, 5.0]] * 2))
    again = UserTrack("track_00001", second.frames, second.xy)
    found = solve_again(result, tracks=UserTracks([first, once, never, again]))
    assert [name for name in found.track_names() if name in ("window 0", "track_00001_2", "window 9")] == [
        "window 0", "track_00001_2",
    ]  # fmt: skip
    assert found.notes[-2:] == [
        "Supervised tracks without a point, since the solved frames do not place it: window 9.",
        "Of the tracks, 1 of 4 have no frame of the shot.",
    ]
    with pytest.raises(
        InputError, match=r"no track has two frames of the shot; its frames are 0 to 7.*--tracks-first-frame"
    ):
        solve_again(result, tracks=UserTracks([once, never]))


def test_tracks_of_another_size_are_refused(result: Reconstruction, tracks: UserTracks, tmp_path: Path) -> None:
    moving = tracks.tracks[0]
    scaled = [UserTrack(track.name, track.frames, 2.0 * track.xy + 0.5) for track in tracks.tracks]
    beyond = np.array([np.maximum(-0.5 - t.xy, t.xy - [319.5, 179.5]).max(axis=1) for t in scaled])
    outside = int((beyond > 5.0).sum())
    assert outside > 20
    message = (
        f"the tracks: {outside} of 64 places are outside of the footage of 320x180 pixels, by up to {beyond.max():.0f};"
    )
    with pytest.raises(InputError, match=message):
        solve_again(result, tracks=UserTracks(scaled))
    said = UserTracks([moving], size=(640, 360))
    with pytest.raises(InputError, match="they are of an image of 640x360 pixels, the footage has 320x180"):
        solve_again(result, tracks=said)
    assert moving.name in solve_again(result, tracks=UserTracks([moving], size=(320, 180))).track_names()


@pytest.mark.parametrize(("beyond", "leaving", "refused"), [(4.9, 8, False), (5.1, 2, False), (5.1, 3, True)])
def test_tracks_may_leave_the_picture(beyond: float, leaving: int, refused: bool, result: Reconstruction) -> None:
    xy = np.tile([100.0, 90.0], (FRAMES, 1))
    xy[:leaving] = [319.5 + beyond, 90.0]
    leaves = UserTracks([UserTrack("leaves", np.arange(FRAMES), xy)])
    if refused:
        with pytest.raises(InputError, match="3 of 8 places are outside of the footage of 320x180 pixels, by up to 5"):
            solve_again(result, tracks=leaves)
    else:
        solve_again(result, tracks=leaves)


@pytest.mark.parametrize("said", [["--tracks-sigma", "0.3"], ["--tracks-on", "footage"], ["--tracks-first-frame", "0"]])
def test_what_is_said_of_tracks_needs_them(
    said: list[str], solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["solve", str(solved)], ["reconstruct", str(tmp_path)]):
        assert main([*command, *said, "--output", str(tmp_path / "out")]) == 2
        assert_error(capsys.readouterr(), f"{said[0]} needs --tracks FILE")
    assert not (tmp_path / "out").exists()


def test_reconstruct_takes_them(tracks: UserTracks, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = rendered("dolly")
    undistorted = UserTracks(tracks.tracks, sigma=0.3, on="undistorted")
    found = reconstruct(shot.images, camera=shot.camera, depth=None, tracks=undistorted)
    assert set(NAMES) < set(found.track_names())
    with pytest.raises(InputError, match="tracks on undistorted footage need its lens"):
        reconstruct(shot.images, depth=None, tracks=undistorted)
    with pytest.raises(InputError, match="tracks of your own go with a video"):
        reconstruct(shot.images, camera=shot.camera, depth=None, tracks=tracks, unordered=True)
    (tmp_path / "tracks.txt").write_text("no tracks")
    command = [
        "reconstruct",
        str(tmp_path),
        "--tracks",
        str(tmp_path / "tracks.txt"),
        "--output",
        str(tmp_path / "out"),
    ]
    assert main(command) == 2
    assert_error(capsys.readouterr(), "tracks.txt: neither a table")
