"""What Blender makes of the exports: its own script, Nuke's .chan by its importer, Nuke's points, the STMap."""

import json
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.camera.other_models import distorting
from factorsfm.camera.projection import with_focal
from factorsfm.control.files import read_control
from factorsfm.export import ExportOptions, export
from factorsfm.result.reconstruction import Reconstruction
from tests.export_problems import (
    PARAMS,
    assert_same_cameras,
    hard_reconstruction,
    moved,
    noise_images,
    numbers,
    seen_points,
    true_world_from_film,
)

SCALE = 3.0
FOCAL = PARAMS[:2]
BLENDER = shutil.which("blender")

pytestmark = pytest.mark.skipif(BLENDER is None, reason="Blender is not installed (Debian's package: blender)")


def run_blender(folder: Path, footage: Path | None, shown: Reconstruction | None = None) -> dict[str, Any]:
    reconstruction = hard_reconstruction()
    options = ExportOptions(scale=SCALE, fps=30000 / 1001, footage=footage)
    export(shown or reconstruction, folder / "scene.py", format="blender", options=options)
    export(reconstruction, folder / "camera.chan", format="chan", options=options)
    export(reconstruction, folder / "nuke", format="nuke", options=options)
    export(reconstruction, folder / "lens", format="lens")
    probe = Path(__file__).with_name("blender_probe.py")
    names = ("scene.py", "camera.chan", "nuke/points.obj", "nuke/undistort.exr", "lens/blender.py", "report")
    files = [folder / name for name in names]
    command = [str(BLENDER), "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(probe)]
    done = subprocess.run([*command, "--", *map(str, files)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((folder / "report").read_text())


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("blender")
    return run_blender(folder, noise_images(folder / "shot", 21))


def film_cameras(frames: list[dict[str, Any]], wanted: list[int]) -> NDArray[np.float64]:
    by_number = {entry["frame"]: entry["world_from_camera"] for entry in frames}
    return np.array([by_number[number] for number in wanted])


def test_scene_has_the_shot_s_frames_and_size(report: dict[str, Any]) -> None:
    scene = report["scene"]
    assert scene["size"] == [640, 480]
    assert scene["fps"] == pytest.approx(30000 / 1001, rel=1e-6)
    assert scene["range"] == [1011, 1021]  # as the files of the footage
    assert scene["keys"] == numbers(hard_reconstruction(), 1001)
    assert scene["not_registered"] == [1017]


def test_blender_s_camera_is_ours_in_every_frame(report: dict[str, Any]) -> None:
    reconstruction = hard_reconstruction()
    scene = report["scene"]
    wanted = numbers(reconstruction, 1001)
    found = film_cameras(scene["frames"], wanted)
    assert_same_cameras(found, true_world_from_film(reconstruction, "z", SCALE))
    by_number = {entry["frame"]: entry for entry in scene["frames"]}
    for position, number in enumerate(wanted):
        entry = by_number[number]
        assert entry["lens"] == pytest.approx(600 * 36 / 640, rel=1e-6)
        points, pixels = seen_points(reconstruction, position)
        world = np.column_stack([moved(points, "z", SCALE), np.ones(len(points))])
        window = world @ (np.array(entry["projection"]) @ np.linalg.inv(found[position])).T
        window = window[:, :2] / window[:, 3:]
        np.testing.assert_allclose((window + 1) / 2 * [640, -480] + [0, 480], pixels, atol=2e-3)


def test_blender_s_camera_zooms(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    mean, factor = reconstruction.camera.mean_focal_length(), 1.0 + 0.05 * np.arange(5)
    for k, frame in zip(factor, reconstruction.registered, strict=True):
        frame.camera = with_focal(reconstruction.camera, mean * k)
    scene = run_blender(tmp_path, None, reconstruction)["scene"]
    found = {entry["frame"]: entry["lens"] for entry in scene["frames"]}
    wanted = numbers(reconstruction, 1)
    np.testing.assert_allclose([found[number] for number in wanted], 600 * 36 / 640 * factor, rtol=1e-6)
    assert found[17] == pytest.approx((found[15] + found[19]) / 2, rel=1e-5)  # linear over the frame that is missing


def test_blender_interpolates_across_the_gap(report: dict[str, Any]) -> None:
    """Also between keys the camera moves straight, and does not spin the long way round."""
    x = {entry["frame"]: entry["world_from_camera"][0][3] for entry in report["scene"]["frames"]}
    assert x[1017] == pytest.approx((x[1015] + x[1019]) / 2, abs=1e-5)
    turns = [np.array(entry["world_from_camera"])[:3, :3] for entry in report["scene"]["frames"]]
    angles = [np.degrees(np.linalg.norm(cv2.Rodrigues(a.T @ b)[0])) for a, b in pairwise(turns)]
    assert max(angles) < 35


def test_blender_s_points_are_ours(report: dict[str, Any]) -> None:
    reconstruction = hard_reconstruction()
    np.testing.assert_allclose(report["scene"]["points"], moved(reconstruction.points, "z", SCALE), rtol=1e-6)
    np.testing.assert_allclose(np.array(report["scene"]["colors"])[:, :3] * 255, reconstruction.colors, atol=0.51)


def test_blender_shows_the_right_file_behind_each_frame(report: dict[str, Any]) -> None:
    background = report["scene"]["background"]
    assert background["source"] == "SEQUENCE"
    names = {frame: Path(file).name for frame, file in background["files"].items()}
    assert names == {"1011": "shot.1011.png", "1021": "shot.1021.png"}


def test_blender_imports_the_chan_file(report: dict[str, Any]) -> None:
    reconstruction = hard_reconstruction()
    wanted = numbers(reconstruction, 1001)
    assert report["chan"]["keys"] == wanted
    found = film_cameras(report["chan"]["frames"], wanted)
    assert_same_cameras(found, true_world_from_film(reconstruction, "y", SCALE))
    lenses = [entry["lens"] for entry in report["chan"]["frames"]]
    np.testing.assert_allclose(lenses, 600 * 36 / 640, rtol=1e-4)


def test_blender_imports_the_points_of_the_nuke_script(report: dict[str, Any]) -> None:
    reconstruction = hard_reconstruction()
    faces = np.array(report["obj"]).reshape(-1, 4, 3, 3)
    middles = faces.mean(axis=(1, 2))
    np.testing.assert_allclose(middles, moved(reconstruction.points, "y", SCALE), atol=1e-5)


def test_blender_reads_the_stmap_from_the_bottom_left(report: dict[str, Any]) -> None:
    exr = report["exr"]
    assert (exr["size"], exr["is_float"]) == ([640, 480], True)
    camera = hard_reconstruction().camera
    for row, values in exr["rows"].items():
        y = 480 - (int(row) + 0.5)  # from the top
        rays = np.column_stack([(np.arange(640) + 0.5 - 290) / 600, np.full(640, (y - 262) / 1200), np.ones(640)])
        places = camera.img_from_cam(rays)
        found = np.array(values).reshape(640, 4)
        np.testing.assert_allclose(found[:, 0] * 640, places[:, 0], atol=1e-3)
        np.testing.assert_allclose(found[:, 1] * 480, 480 - places[:, 1], atol=1e-3)


def test_blender_plays_a_movie_behind_the_camera(tmp_path: Path) -> None:
    movie = tmp_path / "shot.avi"
    writer = cv2.VideoWriter(str(movie), cv2.VideoWriter.fourcc(*"MJPG"), 24, (640, 480))
    for _ in range(21):
        writer.write(np.full((480, 640, 3), 99, np.uint8))
    writer.release()
    background = run_blender(tmp_path, movie)["scene"]["background"]
    assert (background["source"], background["size"]) == ("MOVIE", [640, 480])


def test_blender_s_movie_clip_has_the_lens(report: dict[str, Any]) -> None:
    """Blender distorts with OpenCV's k1 to k3, on pixels made square, about a centre counted from the bottom left."""
    lens = report["lens"]
    assert lens["distortion_model"] == "POLYNOMIAL"
    assert lens["focal_length_pixels"] == pytest.approx(FOCAL[0], rel=1e-6)
    assert lens["pixel_aspect"] == pytest.approx(FOCAL[1] / FOCAL[0], rel=1e-6)
    np.testing.assert_allclose(lens["center"], [290, 480 - 262], atol=1e-3)
    fitted = distorting(hard_reconstruction().camera, 3, 1.0).coefficients
    assert [lens["k1"], lens["k2"], lens["k3"]] == pytest.approx(fitted, rel=1e-5)


def test_what_blender_writes_as_chan_comes_back_as_control(report: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "a.chan").write_text(report["scene"]["written_chan"])
    found = {pose.frame: pose for pose in read_control(tmp_path / "a.chan").poses}
    reconstruction = hard_reconstruction()
    for frame, center in zip(reconstruction.registered, reconstruction.camera_centers(), strict=True):
        pose = found[frame.index]
        np.testing.assert_allclose(np.asarray(pose.position) / SCALE, center, atol=1e-5)
        turn = pycolmap.Rotation3d(np.asarray(pose.cam_from_world)) * frame.cam_from_world.rotation.inverse()
        assert np.degrees(turn.angle()) < 1e-3
