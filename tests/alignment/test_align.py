"""The alignment of a furnished room with exact truth: up, ground, origin, axis and unit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm import Length, Pick, Reconstruction, align, read_result
from factorsfm.alignment.edges import find_edges, up_from_edges
from factorsfm.alignment.ground import level_ground
from factorsfm.alignment.picks import PickedPoint, picked_point, plane_normal
from factorsfm.cli.main import main
from factorsfm.control.fit import ControlFit
from factorsfm.report.result_folder import write_folder
from factorsfm.support.errors import InputError
from tests.report.test_overlay import CAMERA, FLOOR, floor_and_clutter, solved

HEIGHT = FLOOR  # of the first camera above the floor, which is level here


def room(floor: int = 600, noise: float = 0.0) -> Reconstruction:
    """A level floor, a wall behind it and things on it, in a tilted world; the unit is the metre."""
    points = floor_and_clutter(floor=floor, clutter=150, wall=300)
    points[:floor, 1] = FLOOR
    result = solved(points * (1 + noise * np.random.default_rng(5).standard_normal((len(points), 1))))
    result.options = {}
    return result


def pixel(result: Reconstruction, point: np.ndarray, frame: int = 0) -> Pick:
    """Where a frame sees a point, which is given in the axes of the first camera."""
    first, pose = result.frames[0].cam_from_world, result.frames[frame].cam_from_world
    x, y = result.camera.img_from_cam(pose * (first.inverse() * point)) - 0.5
    return Pick(result.frames[frame].index, float(x), float(y))


def in_first_camera(result: Reconstruction, point: np.ndarray) -> np.ndarray:
    return np.asarray(result.frames[0].cam_from_world * np.asarray(point, float))


def test_a_scene_stands_on_its_floor_below_the_first_camera() -> None:
    result = room()
    aligned = align(result)
    known = aligned.alignment
    assert (known.up_from, known.ground_from, known.origin_from, known.x_from) == (
        ["ground"],
        "points",
        "foot",
        "camera",
    )
    np.testing.assert_allclose(aligned.points[:600, 1], 0, atol=1e-9)
    np.testing.assert_allclose(aligned.camera_centers()[0], [0, -HEIGHT, 0], atol=1e-9)
    assert known.camera_height == pytest.approx(HEIGHT, abs=1e-9)
    assert known.ground_height == pytest.approx(0, abs=1e-9)
    assert 0 < known.ground_std < 0.3
    assert known.scale_from is None
    assert "The scale is free." in known.notes
    for before, after in zip(result.frames, aligned.frames, strict=True):
        if before.cam_from_world is not None:
            np.testing.assert_allclose(
                before.cam_from_world * result.points, after.cam_from_world * aligned.points, atol=1e-9
            )


def test_the_points_of_tracks_are_picked_by_their_names() -> None:
    result = room()
    floor = np.asarray(result.frames[0].cam_from_world * result.points)[:600]
    seen = np.flatnonzero(np.bincount(result.observation_point, minlength=600)[:600] >= 2)
    wanted = np.array([[0.3, FLOOR, 4.5], [1.2, FLOOR, 4.6], [0.2, FLOOR, 6.0]])
    rows = [seen[np.argmin(np.linalg.norm(floor[seen] - place, axis=1))] for place in wanted]
    a, b, c = (result.track_names()[row] for row in rows)
    aligned = align(result, origin=a, axis=b, plane=c, distance=Length(a, b, 2.0))
    known = aligned.alignment
    assert (known.up_from, known.origin_from, known.x_from) == (["picks"], "pick", "pick")
    np.testing.assert_allclose(aligned.points[rows[:2]], [[0, 0, 0], [2, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(aligned.points[:600, 1], 0, atol=1e-9)
    assert 0 < known.origin_std < 0.1
    assert 0 < known.scale_std < 0.02
    with pytest.raises(InputError, match=r'"track_99999" is no pixel of a frame, nor a track with a point; FRAME:X,Y'):
        align(result, origin="track_99999")


def test_an_earlier_alignment_is_no_evidence() -> None:
    """Wrong picks can be taken back, and to align twice changes nothing."""
    result = room()
    places = ([0.3, FLOOR, 4.5], [-0.6, FLOOR, 5.5], [0.5, 0.3 * FLOOR, 6.0])
    wrong = align(result, **dict(zip(("origin", "axis", "plane"), (pixel(result, p) for p in places), strict=True)))
    up = wrong.frames[0].cam_from_world.rotation.matrix()[:, 1]  # down in the first camera, where the room is level
    assert np.degrees(np.arccos(up[1])) > 5
    once = align(result)
    for again in (align(wrong), align(once)):
        assert again.alignment.up_from == ["ground"]
        np.testing.assert_allclose(again.points[:600, 1], 0, atol=1e-9)
        assert again.alignment.camera_height == pytest.approx(HEIGHT, abs=1e-9)


def test_origin_axis_and_scale_are_those_of_the_picks() -> None:
    result = room()
    a, b = np.array([0.3, FLOOR, 4.5]), np.array([-0.6, FLOOR, 5.5])
    length = Length(pixel(result, a), pixel(result, b, 5), 2 * float(np.linalg.norm(b - a)), 0.1)
    aligned = align(result, origin=str(pixel(result, a)), axis=pixel(result, b, 4), distance=length)
    known = aligned.alignment
    assert (known.origin_from, known.x_from, known.scale_from) == ("pick", "pick", "distance")
    first = aligned.frames[0].cam_from_world
    np.testing.assert_allclose(in_first_camera(aligned, [0, 0, 0]), 2 * a, atol=0.04)
    np.testing.assert_allclose(first.rotation.matrix()[:, 0], (b - a) / np.linalg.norm(b - a), atol=0.01)
    assert aligned.metric
    assert 0.1 / length.metres <= known.scale_std < 0.1
    assert known.camera_height == pytest.approx(2 * HEIGHT, rel=0.01)


def test_three_picks_are_the_ground_and_a_height_gives_the_scale() -> None:
    result = room()
    corners = [np.array([x, FLOOR, z]) for x, z in ((-0.8, 4.0), (0.8, 4.0), (0.2, 6.0))]
    origin, axis, plane = (pixel(result, corner) for corner in corners)
    aligned = align(result, origin=origin, axis=axis, plane=plane, camera_height=3.0)
    known = aligned.alignment
    assert (known.up_from, known.ground_from, known.scale_from) == (["picks"], "picks", "height")
    assert known.camera_height == pytest.approx(3.0, abs=1e-9)
    np.testing.assert_allclose(aligned.points[:600, 1], 0, atol=0.02)
    np.testing.assert_allclose(
        in_first_camera(aligned, [1, 0, 0]) - in_first_camera(aligned, [0, 0, 0]), [1, 0, 0], atol=0.01
    )


@pytest.mark.parametrize(("frame", "away"), [(0, 0.0), (0, 0.1), (0, 2.9), (5, 0.1), (5, 2.9)])
def test_an_axis_needs_a_direction(frame: int, away: float) -> None:
    result = room()
    place = np.array([0.3, FLOOR, 4.5])
    origin = pixel(result, place)
    there, here = pixel(result, place, frame), f"{origin.x:g},{origin.y:g}"
    message = rf"is [0-9.e-]+ pixels from 0:{here}, which tells no direction; pick one further away"
    with pytest.raises(InputError, match=message):
        align(result, origin=origin, axis=replace(there, x=there.x + away))
    assert align(result, origin=origin, axis=replace(there, x=there.x + 3.5)).alignment.x_from == "pick"


@pytest.mark.parametrize(
    ("third", "std", "message"),
    [
        ((0.0, 1.0, 6.0), 0.01, None),  # of a floor
        ((0.0, 1.0, 4.0), 0.01, "on a line, or nearly; pick a third one off the line"),
        ((0.0, 1.0, 4.2), 0.2, "on a line, or nearly; pick a third one off the line"),
        ((0.0, 1.0, 6.0), 0.2, r"the camera is 1 above the plane .*, give or take 0\.73, which tells no ground; pick"),
        # Behind the row of pixels the scene goes back and forth.
        ((0.0, 1.5, 6.0), 0.01, r"the camera is 0 above the plane .*, give or take 0\.037, which tells no ground"),
        ((0.0, 1.49, 6.0), 0.01, r"the camera is 0\.019 above the plane .*, give or take 0\.037, which tells"),
    ],
)
def test_a_ground_is_no_line_in_the_picture(third: tuple[float, ...], std: float, message: str | None) -> None:
    points = [PickedPoint(np.array(p), std**2 * np.eye(3)) for p in ((-1.0, 1.0, 4.0), (1.0, 1.0, 4.0), third)]
    eyes = [np.zeros(3)] * 3
    if message is not None:
        with pytest.raises(InputError, match=message):
            plane_normal(points, eyes)
        return
    normal, degrees = plane_normal(points, eyes)
    np.testing.assert_allclose(np.abs(normal), [0, 1, 0], atol=1e-12)
    assert degrees == pytest.approx(np.degrees(1.5 * std * np.sqrt(5) / 4), rel=1e-4)  # they are 4 / sqrt(5) broad


def test_covariances_and_priors_go_with_the_unit() -> None:
    result = room()
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    result.frames[1] = replace(result.frames[1], covariance=covariance)
    aligned = align(result, camera_height=2 * HEIGHT)
    np.testing.assert_allclose(aligned.frames[1].covariance, np.diag([1, 2, 3, 16, 20, 24]), rtol=1e-9)


def test_what_nothing_tells_is_not_known() -> None:
    result = solved(floor_and_clutter(floor=0, clutter=200))
    result.options = {}
    aligned = align(result)
    known = aligned.alignment
    assert (known.up_from, known.up_std, known.ground_from, known.origin_from) == ([], None, None, "camera")
    assert any("not known" in note for note in known.notes)
    np.testing.assert_allclose(aligned.frames[0].cam_from_world.matrix(), np.eye(4)[:3], atol=1e-12)
    with pytest.raises(InputError, match="the ground is not known, so the height"):
        align(result, camera_height=1.0)


def test_a_floor_without_points_is_not_replaced_by_what_stands_on_it() -> None:
    result = solved(floor_and_clutter(floor=0, clutter=400, wall=400))
    first = result.frames[0].cam_from_world
    assert level_ground(result, -first.rotation.matrix()[1], 0.3) is None


def test_a_pick_says_how_well_its_place_is_known() -> None:
    exact, rough = room(), room(noise=0.02)
    place = np.array([0.2, FLOOR, 5.0])
    for result, low, high in ((exact, 0.0, 0.04), (rough, 0.04, 0.5)):
        found = picked_point(result, pixel(result, place))
        error = np.linalg.norm(in_first_camera(result, found.position) - place)
        assert low <= found.std <= high
        assert error < 3 * found.std


@pytest.mark.parametrize("tilt", [0.0, 12.0])
def test_up_comes_from_edges(tilt: float) -> None:
    """Boxes drawn with exact edges, from a camera that looks down and is rolled."""
    camera = pycolmap.Camera(model="PINHOLE", width=960, height=540, params=[800, 800, 480, 270])
    rotation = pycolmap.Rotation3d(np.radians([tilt, 25.0, 3.0]))
    image = np.full((540, 960, 3), 220, np.uint8)
    rng = np.random.default_rng(0)
    for _ in range(25):
        corner = np.array([*rng.uniform(-3, 2.5, 2), rng.uniform(5, 9)])
        size = rng.uniform(0.4, 1.2, 3)
        corners = corner + size * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        seen = np.round(8 * camera.img_from_cam(corners @ rotation.matrix().T)).astype(int)
        for face in ([0, 1, 3, 2], [0, 4, 5, 1], [0, 4, 6, 2]):
            shade = int(rng.integers(30, 200))
            cv2.fillConvexPoly(image, seen[face].reshape(-1, 1, 2), (shade, shade, shade), cv2.LINE_AA, 3)
    pose = pycolmap.Rigid3d(rotation, np.zeros(3))
    found = up_from_edges(find_edges([(image, camera, pose)]), -rotation.matrix()[1])
    assert found is not None
    up, std = found
    error = np.degrees(np.arccos(np.clip(up @ [0, -1, 0], -1, 1)))
    assert 0.25 < std < 1.0
    assert error < 1.0


def test_noise_has_no_up() -> None:
    image = np.random.default_rng(0).integers(0, 255, (270, 480, 3)).astype(np.uint8)
    edges = find_edges([(image, CAMERA, pycolmap.Rigid3d())])
    assert up_from_edges(edges, np.array([0.0, -1.0, 0.0])) is None


def test_the_command_writes_a_result_that_says_how_it_is_aligned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = room()
    write_folder(result, tmp_path / "result")
    assert main(["align", str(tmp_path / "result"), "--camera-height", "1.5"]) == 0
    said = capsys.readouterr().out
    assert "The ground, on which" in said
    again = read_result(tmp_path / "result")
    assert again.metric
    assert again.alignment.scale_from == "height"
    assert again.camera_centers()[0] == pytest.approx([0, -1.5, 0], abs=1e-6)
    assert '"ground":' in (tmp_path / "result" / "report.html").read_text()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"axis": "0:1,1"}, "an axis needs an origin"),
        ({"origin": "here"}, '"here" is no pixel of a frame'),
        ({"origin": "77:1,1"}, "the result has no frame 77"),
        ({"origin": "3:1,1"}, "the frame has no pose"),
        ({"origin": "0:900,1"}, "outside of the frame, which has 480x270"),
        ({"camera_height": -1.0}, "the camera height is -1"),
        ({"distance": Length("0:240,200", "0:240,200", 1.0)}, "pick points further apart"),
        ({"origin": ""}, '"" is no pixel of a frame, nor a track with a point; FRAME:X,Y is expected'),
        ({"origin": "0:240,200", "axis": ""}, '"" is no pixel of a frame, nor a track with a point'),
        ({"camera_height": 1e300}, r"the camera height is 1e\+300; a number of metres from 1e-09 to 1e\+09 is"),
        ({"distance": Length("0:100,200", "0:400,200", 1e300)}, r"the distance is 1e\+300; a number of metres from"),
        ({"distance": Length("0:100,200", "0:400,200", 1e-300)}, "the distance is 1e-300; a number of metres from"),
        ({"distance": Length("0:100,200", "0:400,200", 1.0, 1e300)}, r"deviation of the distance is 1e\+300; 0 to"),
        ({"distance": Length("0:1,1", "0:9,9", 1.0), "camera_height": 1.0}, "one of them sets the scale"),
    ],
)
def test_what_cannot_be_used_is_refused(given: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        align(room(), **given)


def test_a_surveyed_world_is_left_alone() -> None:
    result = replace(room(), control=ControlFit([], [], [], placed=True, scale_std=0.01, position_std=0.1))
    with pytest.raises(InputError, match="in the world of its control"):
        align(result)
