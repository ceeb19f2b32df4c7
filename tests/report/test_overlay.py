"""Planes found in points with known truth; the overlay read back, with its objects where they belong."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.alignment.planes import find_plane
from factorsfm.cli.main import main
from factorsfm.frames.reading import read_frames
from factorsfm.report.overlay import Projector, draw_overlay, write_overlay
from factorsfm.report.props import place_props
from factorsfm.report.result_folder import write_folder
from factorsfm.result.alignment import Alignment
from factorsfm.result.moving import Moving, MovingStretch
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import Similarity
from factorsfm.support.status import FrameStatus, ShotKind
from tests.exact_result import build

CAMERA = pycolmap.Camera(model="OPENCV", width=480, height=270, params=[400, 410, 243, 133, -0.12, 0.02, 0.001, 0.001])
FLOOR, TILT = 1.2, np.radians(4)
FRAMES = 6


def floor_and_clutter(floor: int = 250, clutter: int = 150, wall: int = 0, noise: float = 0.0) -> np.ndarray:
    """A floor that falls away a little to the right, points anywhere above it, a wall at its end."""
    rng = np.random.default_rng(3)
    x, z = rng.uniform(-2, 2, floor), rng.uniform(3, 7, floor)
    parts = [
        np.column_stack([x, FLOOR + np.tan(TILT) * x, z]),
        np.column_stack([rng.uniform(-2, 2, clutter), rng.uniform(-1.5, 0.9, clutter), rng.uniform(3, 7, clutter)]),
        np.column_stack([rng.uniform(-2, 2, wall), rng.uniform(-1.5, 1, wall), np.full(wall, 7.5)]),
    ]
    points = np.concatenate(parts)
    return points * (1 + noise * rng.standard_normal((len(points), 1)))


def solved(points: np.ndarray, lost: tuple[int, ...] = (3,), first: int = 0, step: int = 1) -> Reconstruction:
    """A truck with a little turn over exact points; cameras do not start at the world's origin."""
    world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.3, -0.2, 0.1])), np.array([0.5, 1.0, -2.0]))
    frames, frame_of, point_of, xy = [], [], [], []
    for k in range(FRAMES):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.01 * k, 0.0])), np.array([-0.06 * k, 0.0, 0.0]))
        pixels = CAMERA.img_from_cam(pose * points) - 0.5
        seen = np.flatnonzero(((pixels >= 0) & (pixels <= [479, 269])).all(axis=1))
        frame_of += [k] * len(seen)
        point_of += seen.tolist()
        xy.append(pixels[seen])
        status = FrameStatus.BLANK if k in lost else FrameStatus.REGISTERED
        index = first + step * k
        frames.append(FrameResult(index, f"{index:06d}", index / 25, status, "", None if k in lost else pose * world))
    return Reconstruction(
        camera=CAMERA,
        frames=frames,
        points=world.inverse() * points,
        colors=np.full((len(points), 3), 128, np.uint8),
        track_ids=np.arange(len(points)),
        observation_frame=np.array(frame_of),
        observation_point=np.array(point_of),
        observation_xy=np.concatenate(xy),
        observation_error=np.zeros(len(frame_of)),
        prior_residual=np.full(len(frame_of), np.nan),
        kind=ShotKind.GENERAL,
        parallax=0.05,
    )


def write_footage(path: Path, frames: int = FRAMES, width: int = 480, grey: int = 100) -> Path:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (width, 270))
    for _ in range(frames):
        video.write(np.full((270, width, 3), grey, np.uint8))
    video.release()
    return path


def in_first_camera(reconstruction: Reconstruction, points: np.ndarray) -> np.ndarray:
    pose = reconstruction.frames[0].cam_from_world
    return np.asarray(pose * points.reshape(-1, 3))


@pytest.mark.parametrize(("noise", "degrees", "off"), [(0.0, 1e-6, 1e-9), (0.004, 1.0, 0.02)])
def test_the_ground_is_found(noise: float, degrees: float, off: float) -> None:
    reconstruction = solved(floor_and_clutter(wall=200, noise=noise))
    plane = find_plane(reconstruction)
    assert plane.kind == "ground"
    up = np.array([np.sin(TILT), -np.cos(TILT), 0.0])
    turned = reconstruction.frames[0].cam_from_world.rotation.matrix() @ plane.axes.T
    assert np.degrees(np.arccos(np.clip(turned[:, 2] @ up, -1, 1))) <= degrees
    assert abs((in_first_camera(reconstruction, plane.origin)[0] - [0, FLOOR, 0]) @ up) <= off
    np.testing.assert_allclose(plane.axes @ plane.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(plane.axes) == pytest.approx(1)
    assert turned[0, 0] > 0.95  # along the camera's right
    assert np.isin(np.arange(250), plane.support).mean() > (0.99 if noise == 0 else 0.85)
    again = find_plane(reconstruction)
    np.testing.assert_array_equal(again.axes, plane.axes)


def test_without_a_ground_the_wall_is_taken_and_no_cut_through_it() -> None:
    reconstruction = solved(floor_and_clutter(floor=0, clutter=60, wall=300))
    plane = find_plane(reconstruction)
    assert plane.kind == "plane"
    normal = reconstruction.frames[0].cam_from_world.rotation.matrix() @ plane.axes[2]
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)


def test_a_ground_with_few_points_is_preferred_to_a_wall_and_to_a_table() -> None:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-1, 1, 60), np.full(60, 0.4), rng.uniform(3, 5, 60)])
    points = np.concatenate([floor_and_clutter(floor=60, clutter=80, wall=500), table])
    assert find_plane(solved(points)).kind == "ground"
    assert np.isin(np.arange(60), find_plane(solved(points)).support).mean() > 0.9
    # A table alone is none: a good share of the points lies below it.
    points = np.concatenate([floor_and_clutter(floor=0, clutter=0, wall=500), table])
    assert find_plane(solved(points)).kind == "plane"


def test_without_any_plane_there_is_one_at_the_median_distance() -> None:
    reconstruction = solved(floor_and_clutter(floor=0, clutter=200))
    plane = find_plane(reconstruction)
    assert plane.kind == "distance"
    z = in_first_camera(reconstruction, reconstruction.points)[:, 2]
    assert in_first_camera(reconstruction, plane.origin)[0, 2] == pytest.approx(np.median(z), rel=0.015)


def test_too_little_is_refused() -> None:
    with pytest.raises(InputError, match="5 cameras and 10 points"):
        find_plane(solved(floor_and_clutter(floor=10, clutter=0)))


def test_grid_and_cubes_stand_on_the_ground() -> None:
    reconstruction = solved(floor_and_clutter())
    props = place_props(reconstruction)
    coordinates = (props.grid - props.plane.origin) @ props.plane.axes.T
    np.testing.assert_allclose(coordinates[..., 2], 0, atol=1e-12)
    covered = coordinates.reshape(-1, 3)[:, :2]
    assert (covered.min(axis=0) <= props.plane.extent[0]).all()
    assert (covered.max(axis=0) >= props.plane.extent[1]).all()
    assert 10 <= len(props.grid) <= 40
    assert 2 <= len(props.cubes) <= 3
    corners = (props.cubes - props.plane.origin) @ props.plane.axes.T
    np.testing.assert_allclose(corners[:, :4, 2], 0, atol=1e-12)
    np.testing.assert_allclose(corners[:, 4:, 2], props.cell, atol=1e-12)
    sides = np.linalg.norm(np.diff(props.cubes[:, [0, 1, 2, 3, 0]], axis=1), axis=2)
    np.testing.assert_allclose(sides, props.cell, atol=1e-12)
    assert in_first_camera(reconstruction, props.cubes[:, 4:]).mean(axis=0)[1] < FLOOR  # upwards in the picture


def test_projection_follows_the_lens_and_leaves_out_what_is_not_in_view() -> None:
    reconstruction = solved(floor_and_clutter())
    project = Projector.of(reconstruction)
    for k in (0, 5):
        mine = reconstruction.observation_frame == k
        points = reconstruction.points[reconstruction.observation_point[mine]]
        pixels = project(reconstruction.frames[k].cam_from_world, points[None])[0]
        np.testing.assert_allclose(pixels, reconstruction.observation_xy[mine], atol=1e-9)
    far = np.array([[0, 0, -5], [0, 0, 1e-4], [20, 0, 5], [0, -9, 5], [np.nan, 0, 0]], np.float64)
    world = reconstruction.frames[0].cam_from_world.inverse() * far
    assert np.isnan(project(reconstruction.frames[0].cam_from_world, world)).all()


def test_objects_are_drawn_where_they_belong() -> None:
    reconstruction = solved(floor_and_clutter())
    props, project = place_props(reconstruction), Projector.of(reconstruction)
    empty = np.full((270, 480, 3), 100, np.uint8)
    for k in (0, 5):
        pose = reconstruction.frames[k].cam_from_world
        for layer, places, reach in (
            ("grid", project(pose, props.grid).reshape(-1, 2), 2),
            ("cubes", project(pose, props.cubes).reshape(-1, 2), 3),
            ("points", reconstruction.observation_xy[reconstruction.observation_frame == k], 1),
        ):
            drawn = draw_overlay(reconstruction, k, empty, props, project, [layer])
            changed = np.abs(drawn.astype(int) - 100).max(axis=2) > 20
            changed[:40, :60] = False  # the label
            near = cv2.dilate(changed.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1)))
            inside = np.isfinite(places[:, 0]) & ((places >= 5) & (places <= [474, 264])).all(axis=1)
            inside &= (places > [60, 40]).any(axis=1)
            assert inside.sum() >= 8
            at = np.round(places[inside]).astype(int)
            assert near[at[:, 1], at[:, 0]].all(), layer
            if layer == "points":  # and nothing is drawn elsewhere
                mask = np.zeros_like(near)
                mask[at[:, 1], at[:, 0]] = 1
                assert not (changed & (cv2.dilate(mask, np.ones((9, 9))) == 0))[10:-10, 10:-10].any()
            if layer == "cubes":
                hull = np.zeros_like(near)
                for corners in project(pose, props.cubes):
                    cv2.fillConvexPoly(hull, np.round(cv2.convexHull(corners.astype(np.float32))).astype(int), 1)
                assert not (changed & (cv2.dilate(hull, np.ones((7, 7))) == 0)).any()


def test_what_moves_by_itself_has_a_colour_and_a_legend() -> None:
    reconstruction = solved(floor_and_clutter())
    props, project = place_props(reconstruction), Projector.of(reconstruction)
    grey = np.full((270, 480, 3), 100, np.uint8)
    places = np.array([[60.0, 40.0], [400.25, 200.5], [240.0, 100.0]])
    stretches = (MovingStretch(0, 1, 0.1, 0.1),)
    moving = Moving(stretches, np.array([0, 0, 1]), np.arange(3), places)
    plain = draw_overlay(reconstruction, 0, grey, props, project, [])
    marked = draw_overlay(replace(reconstruction, moving=moving), 0, grey, props, project, ["moving"])
    changed = (marked != plain).any(axis=2)
    legend = changed.copy()
    legend[:200] = legend[:, 240:] = False
    assert 300 < legend.sum() < 3000
    crosses = changed & ~legend
    v, u = np.nonzero(crosses)
    distance = np.abs(np.stack([u, v], 1)[:, None] - places[:2]).max(axis=2)
    assert distance.min(axis=1).max() <= 4
    assert (np.bincount(distance.argmin(axis=1), minlength=2) > 6).all()
    blue, green, red = marked[40, 60].astype(int)
    assert min(blue, red) > green + 100
    hidden = draw_overlay(replace(reconstruction, moving=moving), 0, grey, props, project, ["points", "grid"])
    np.testing.assert_array_equal(hidden, draw_overlay(reconstruction, 0, grey, props, project, ["points", "grid"]))


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".mov"])
def test_the_video_is_read_back(tmp_path: Path, suffix: str) -> None:
    reconstruction = solved(floor_and_clutter())
    seen: list[int] = []
    props = write_overlay(
        reconstruction,
        tmp_path / f"overlay{suffix}",
        write_footage(tmp_path / "shot.avi"),
        progress=lambda stage, done, total: seen.append(done),
    )
    frames = list(read_frames(tmp_path / f"overlay{suffix}"))
    assert (len(frames), frames[0].image.shape) == (FRAMES, (270, 480, 3))
    assert frames[1].timestamp == pytest.approx(1 / 25, abs=1e-3)
    assert seen == list(range(FRAMES))
    project = Projector.of(reconstruction)
    for k, frame in enumerate(frames):
        if k == 3:  # lost: the footage with a red word
            assert np.abs(frame.image[60:].astype(int) - 100).max() < 30
            assert frame.image[:40, :, 2].max() > 180
            continue
        expected = draw_overlay(reconstruction, k, np.full((270, 480, 3), 100, np.uint8), props, project)
        assert np.abs(frame.image.astype(int) - expected).mean() < 6
        assert np.abs(frame.image.astype(int) - 100).mean() > 4
    assert [path.name for path in sorted(tmp_path.iterdir())] == [f"overlay{suffix}", "shot.avi"]


def test_ranges_steps_and_odd_sizes(tmp_path: Path) -> None:
    reconstruction = solved(floor_and_clutter(), first=4, step=3)
    reconstruction.camera = replace_width(481)
    folder = tmp_path / "shot"
    folder.mkdir()
    for k in range(25):
        cv2.imwrite(str(folder / f"{k:03d}.png"), np.full((270, 481, 3), 4 * k, np.uint8))
    write_overlay(reconstruction, tmp_path / "o.avi", folder, hide=["grid", "cubes", "points"])
    frames = list(read_frames(tmp_path / "o.avi"))
    assert frames[0].image.shape == (270, 482, 3)
    np.testing.assert_allclose([np.median(f.image) for f in frames], [16, 28, 40, 52, 64, 76], atol=2)
    assert frames[1].timestamp == pytest.approx(3 / 25, abs=2e-5)


def test_the_grid_is_on_the_ground_to_which_the_result_is_aligned(tmp_path: Path) -> None:
    """Also where a wall has more points than what lies on the ground."""
    points = floor_and_clutter(floor=16, clutter=0, wall=600)
    points[:16, 1] = FLOOR
    first = (result := solved(points)).frames[0].cam_from_world
    result = in_other_world(result, Similarity(1.0, first.rotation.matrix(), first.translation))
    assert place_props(result).plane.kind == "plane"
    known = Alignment(["picks"], 0.1, "picks", -FLOOR, 0.1, 3, FLOOR, "camera", None, "camera", None, None)
    aligned = replace(result, alignment=known)
    props = write_overlay(aligned, tmp_path / "o.avi", write_footage(tmp_path / "shot.avi"), hide=["grid", "cubes"])
    assert props.plane.kind == "ground"
    np.testing.assert_allclose(props.plane.axes[2], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(props.plane.origin[1], FLOOR, atol=1e-9)


def replace_width(width: int) -> pycolmap.Camera:
    camera = pycolmap.Camera(CAMERA.todict())
    camera.width = width
    return camera


@pytest.mark.parametrize(
    ("words", "output", "source", "hide"),
    [
        ("an overlay is a video", "o.gif", "shot.avi", []),
        ("no 'cats' to hide", "o.mp4", "shot.avi", ["cats"]),
        ("say where the shot is", "o.mp4", None, []),
        ("has no frame 4", "o.mp4", "short.avi", []),
        (r"320x270 pixels \(aspect ratio 1.185\) and the result 480x270 \(1.778\)", "o.mp4", "narrow.avi", []),
        ("does not exist", "o.mp4", "missing.avi", []),
    ],
)
def test_bad_input_leaves_nothing(tmp_path: Path, words: str, output: str, source: str | None, hide: list[str]) -> None:
    write_footage(tmp_path / "shot.avi")
    write_footage(tmp_path / "short.avi", frames=4)
    write_footage(tmp_path / "narrow.avi", width=320)
    before = {path.name for path in tmp_path.iterdir()}
    given = None if source is None else tmp_path / source
    with pytest.raises(InputError, match=words):
        write_overlay(solved(floor_and_clutter()), tmp_path / output, given, hide=hide)
    assert {path.name for path in tmp_path.iterdir()} == before


def test_nothing_solved_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frame of this shot is solved"):
        write_overlay(build(unregistered=tuple(range(6))), tmp_path / "o.mp4", write_footage(tmp_path / "shot.avi"))


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_footage(tmp_path / "shot.avi")
    reconstruction = solved(floor_and_clutter())
    reconstruction = replace(reconstruction, options={"source": str(tmp_path / "shot.avi")})
    write_folder(reconstruction, tmp_path / "result")
    output = tmp_path / "overlay.mp4"
    assert main(["overlay", str(tmp_path / "result"), "--output", str(output), "--hide", "points"]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"Wrote {output}: the grid is on the ground that ")
    assert len(list(read_frames(output))) == FRAMES
    (tmp_path / "shot.avi").unlink()
    output.unlink()
    assert main(["overlay", str(tmp_path / "result"), "--output", str(output)]) == 2
    assert "say where the shot is" in capsys.readouterr().err
    assert not output.exists()
