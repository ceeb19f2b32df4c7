"""The files of a result, read back by pycolmap, by a plain parser and bit by bit."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from factorsfm.camera.files import read_camera
from factorsfm.export import export, write_colmap, write_ply, write_trajectory
from factorsfm.report.result_folder import check_directory, write_failure, write_folder
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from tests.exact_result import FILES, build


def shuffled(reconstruction: Reconstruction) -> Reconstruction:
    order = np.random.default_rng(2).permutation(len(reconstruction.observation_frame))
    return replace(
        reconstruction,
        observation_frame=reconstruction.observation_frame[order],
        observation_point=reconstruction.observation_point[order],
        observation_xy=reconstruction.observation_xy[order],
        observation_error=reconstruction.observation_error[order],
        prior_residual=reconstruction.prior_residual[order],
    )


def test_trajectory_is_camera_to_world_with_frame_indices(tmp_path: Path) -> None:
    reconstruction = build()
    write_trajectory(reconstruction, tmp_path / "t.tum")
    rows = np.loadtxt(tmp_path / "t.tum")
    assert rows[:, 0].tolist() == [10, 12, 14, 18, 20]
    np.testing.assert_allclose(rows[:, 1:4], reconstruction.camera_centers(), atol=1e-11)
    for row, frame in zip(rows, reconstruction.registered, strict=True):
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(row[4:8]), row[1:4])
        identity = (frame.cam_from_world * world_from_cam).matrix()
        np.testing.assert_allclose(identity, np.eye(3, 4), atol=1e-10)


def test_colmap_model_reprojects_exactly_in_pycolmap(tmp_path: Path) -> None:
    reconstruction = shuffled(build())
    write_colmap(reconstruction, tmp_path / "colmap")
    assert {p.name for p in (tmp_path / "colmap").iterdir()} == {"cameras.txt", "images.txt", "points3D.txt"}
    model = pycolmap.Reconstruction(tmp_path / "colmap")
    assert (model.num_reg_images(), model.num_points3D(), model.compute_num_observations()) == (5, 40, 200)
    (camera,) = model.cameras.values()
    assert camera.model_name == "OPENCV"
    np.testing.assert_array_equal(camera.params, reconstruction.camera.params)
    worst = 0.0
    for frame in reconstruction.registered:
        image = model.image(frame.index + 1)
        assert image.name == f"{frame.name}.png"
        np.testing.assert_allclose(image.cam_from_world().matrix(), frame.cam_from_world.matrix(), atol=1e-14)
        for point2d in image.points2D:
            xyz = model.point3D(point2d.point3D_id).xyz
            pixel = camera.img_from_cam((image.cam_from_world() * xyz)[None])[0]
            worst = max(worst, float(np.abs(pixel - point2d.xy).max()))
    assert worst < 1e-6  # the text holds six decimals of a pixel
    point = model.point3D(int(reconstruction.track_ids[7]) + 1)
    np.testing.assert_array_equal(point.xyz, reconstruction.points[7])
    np.testing.assert_array_equal(point.color, reconstruction.colors[7])
    assert point.error == pytest.approx(0.1 * np.mean([1, 2, 3, 5, 6]), rel=1e-5)


def test_colmap_text_in_a_plain_parser(tmp_path: Path) -> None:
    reconstruction = build()
    write_colmap(reconstruction, tmp_path)
    images = [x for x in (tmp_path / "images.txt").read_text().split("\n") if not x.startswith("#")]
    header, observations = images[0].split(), images[1].split()
    assert (header[0], header[8], header[9]) == ("11", "1", "000010.png")
    qx, qy, qz, qw = reconstruction.frames[0].cam_from_world.rotation.quat
    assert [float(v) for v in header[1:5]] == [qw, qx, qy, qz]
    np.testing.assert_allclose(
        np.array(observations, float).reshape(-1, 3)[:, :2],
        reconstruction.observation_xy[:40] + 0.5,
        atol=1e-6,
    )
    tracks = [line.split() for line in (tmp_path / "points3D.txt").read_text().splitlines()[1:]]
    assert [int(t[0]) for t in tracks] == list(range(101, 141))
    for track in tracks:
        for image_id, place in np.array(track[8:], int).reshape(-1, 2):
            row = images[2 * [11, 13, 15, 19, 21].index(image_id) + 1].split()
            assert row[3 * place + 2] == track[0]


def test_colmap_leaves_out_points_seen_by_fewer_than_two_registered_frames(tmp_path: Path) -> None:
    reconstruction = build()
    # point 5 remains in frames 0 and 3 only, and 3 is not registered; point 6 is not seen at all
    frame, point = reconstruction.observation_frame, reconstruction.observation_point
    keep = ((point != 5) | np.isin(frame, [0, 3])) & (point != 6)
    reconstruction.observation_frame = frame[keep]
    reconstruction.observation_point = point[keep]
    reconstruction.observation_xy = reconstruction.observation_xy[keep]
    reconstruction.observation_error = np.full(int(keep.sum()), np.nan)
    write_colmap(reconstruction, tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    assert set(model.points3D) == set(range(101, 141)) - {106, 107}
    assert all(len(image.points2D) == 38 for image in model.images.values())
    assert all(point.error == -1 for point in model.points3D.values())


@pytest.mark.parametrize("space", [" ", "\t", "\n", "\r\n# "])
def test_colmap_image_without_observations_and_names_with_white_space(tmp_path: Path, space: str) -> None:
    reconstruction = build()
    for k, frame in enumerate(reconstruction.frames):
        frame.name = f"my{space}shot {k}.jpg"
    keep = reconstruction.observation_frame != 1
    reconstruction.observation_frame = reconstruction.observation_frame[keep]
    reconstruction.observation_point = reconstruction.observation_point[keep]
    reconstruction.observation_xy = reconstruction.observation_xy[keep]
    reconstruction.observation_error = reconstruction.observation_error[keep]
    write_colmap(reconstruction, tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    assert {i: image.name for i, image in model.images.items()} == {
        11 + 2 * k: f"my{space}shot {k}.jpg" for k in (0, 1, 2, 4, 5)
    }
    assert len(model.image(13).points2D) == 0
    assert len(model.image(15).points2D) == 40


@pytest.mark.parametrize("space", [False, True])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_colmap_files_that_are_cut_off_are_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, space: bool
) -> None:
    reconstruction = build()
    if space:  # text cannot hold the name, and the binary files are written beside it
        reconstruction.frames[0].name = "mein Schuß.jpg"
    write, sizes = pycolmap.Reconstruction.write_binary, {}
    lost = 0

    def cut_off(model: pycolmap.Reconstruction, folder: Path) -> None:
        write(model, folder)
        sizes[name] = (folder / name).stat().st_size
        os.truncate(folder / name, sizes[name] - lost)

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", cut_off)
    format = "colmap" if space else "colmap-binary"
    export(reconstruction, tmp_path / "whole", format=format)
    assert pycolmap.Reconstruction(tmp_path / "whole").compute_num_observations() == 200
    lost = 1
    with pytest.raises(InputError, match=f"only {sizes[name] - 1} of {sizes[name]} bytes of {name} are written"):
        export(reconstruction, tmp_path / "short", format=format)
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


def test_colmap_is_fast(tmp_path: Path) -> None:
    reconstruction = build(frames=80, points=2000, unregistered=())
    start = time.process_time()
    write_colmap(reconstruction, tmp_path)
    assert time.process_time() - start < 3.0
    assert pycolmap.Reconstruction(tmp_path).compute_num_observations() == 160_000


def test_ply_holds_the_points(tmp_path: Path) -> None:
    reconstruction = build()
    write_ply(reconstruction, tmp_path / "p.ply")
    header, body = (tmp_path / "p.ply").read_bytes().split(b"end_header\n", 1)
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 40\n" in header
    vertices = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    np.testing.assert_array_equal(vertices["xyz"], reconstruction.points.astype(np.float32))
    np.testing.assert_array_equal(vertices["rgb"], reconstruction.colors)


def test_folder_holds_everything_and_the_summary_is_valid_json(tmp_path: Path) -> None:
    reconstruction = build()
    reconstruction.write(tmp_path / "new" / "out")
    out = tmp_path / "new" / "out"
    assert {p.name for p in out.iterdir()} == FILES
    assert [p.name for p in out.parent.iterdir()] == ["out"]

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    summary = json.loads((out / "summary.json").read_text(), parse_constant=refuse)
    assert summary["program"] == "factorsfm"
    assert summary["reconstructed"] is True
    counts = {key: summary[key] for key in ("frames", "registered", "keyframes", "points", "observations")}
    assert counts == {"frames": 6, "registered": 5, "keyframes": 3, "points": 40, "observations": 240}
    assert (summary["kind"], summary["metric"], summary["parallax"]) == ("general", False, 0.0123)
    assert summary["focal_length"] == 505
    assert summary["seconds"] == {"tracking": 1.5, "mapping": 2.0, "total": 3.5}
    assert summary["options"] == {
        "source": "shot.mp4",
        "tracker": {"window": 21},
        "sigma": None,
        "path": "a",
    }
    lost, kept = summary["statuses"][3], summary["statuses"][2]
    assert (lost["index"], lost["status"], lost["registered"]) == (16, "too_few_inliers", False)
    assert lost["message"] == "14 of 30 inliers needed"
    assert lost["reprojection_error"] is None
    assert lost["prior"] is None
    assert kept["prior"] == {
        "scale": 4.0,
        "scale_std": 0.2,
        "shift": 0.1,
        "shift_std": 0.02,
        "sigma": 0.3,
        "smooth": 0.0,
    }
    (tmp_path / "camera.json").write_text(json.dumps(summary["camera"]))
    camera = read_camera(tmp_path / "camera.json")
    np.testing.assert_allclose(camera.params, reconstruction.camera.params, atol=1e-12)


def test_folder_replaces_an_earlier_result_and_keeps_other_files(tmp_path: Path) -> None:
    write_folder(build(), tmp_path)  # an empty folder that exists
    (tmp_path / "mine.txt").write_text("x")
    (tmp_path / "colmap" / "stale.bin").write_text("x")
    write_folder(build(frames=4), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == FILES | {"mine.txt"}
    assert not (tmp_path / "colmap" / "stale.bin").exists()
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 4
    assert len((tmp_path / "trajectory.tum").read_text().splitlines()) == 3


@pytest.mark.parametrize("content", ["{}", "[1]", "not json", '{"program": "other"}'])
def test_folder_that_holds_something_else_is_refused_and_untouched(tmp_path: Path, content: str) -> None:
    (tmp_path / "summary.json").write_text(content)
    for call in (lambda: write_folder(build(), tmp_path), lambda: check_directory(tmp_path)):
        with pytest.raises(InputError, match="no earlier factorsfm result"):
            call()
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("summary.json", content)]


def test_unwritable_output_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        for call in (lambda o=output: write_folder(build(), o), lambda o=output: check_directory(o)):
            with pytest.raises(InputError, match=r"cannot write to the output folder .*file"):
                call()
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("kind", ["a pipe", "a link that leads nowhere"])
def test_a_result_takes_the_place_of_nothing_but_a_folder(tmp_path: Path, kind: str) -> None:
    output = tmp_path / "output"
    if kind == "a pipe":
        os.mkfifo(output)
    else:
        output.symlink_to("absent")
    mode = output.lstat().st_mode
    for call in (lambda: write_folder(build(), output), lambda: check_directory(output)):
        with pytest.raises(InputError, match=rf"cannot write to the output folder .*output: it is {kind}"):
            call()
    assert [(path.name, path.lstat().st_mode) for path in tmp_path.iterdir()] == [("output", mode)]


@pytest.mark.parametrize("existing", [False, True])
def test_an_error_half_way_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: bool
) -> None:
    out = tmp_path / "out"
    if existing:
        write_folder(build(), out)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("factorsfm.report.result_folder.write_ply", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_folder(build(frames=4), out)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    assert out.exists() == existing


def test_failure_writes_only_the_reason(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_folder(build(), out)
    write_failure(out, "no texture", build().frames, {"preset": "default"}, {"tracking": 1.0})
    assert {p.name for p in out.iterdir()} == {"summary.json", "report.html"}
    assert "No texture." in (out / "report.html").read_text(encoding="utf-8")
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["reconstructed"], summary["reason"]) == (False, "no texture")
    assert (summary["frames"], summary["options"]) == (6, {"preset": "default"})
    assert summary["seconds"] == {"tracking": 1.0, "total": 1.0}
    write_folder(build(), out)  # a failure is an earlier result, too
    assert {p.name for p in out.iterdir()} == FILES


def test_empty_reconstruction_is_written(tmp_path: Path) -> None:
    empty = build(frames=2, points=0, unregistered=(0, 1))
    write_folder(empty, tmp_path / "out")
    assert (tmp_path / "out" / "trajectory.tum").read_text() == ""
    assert pycolmap.Reconstruction(tmp_path / "out" / "colmap").num_points3D() == 0
