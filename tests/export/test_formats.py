"""Each format read back by another tool than ours, or by a small parser that follows the other tool's conventions."""

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.cli.main import main
from factorsfm.export import FORMATS, ExportOptions, export
from factorsfm.support.errors import InputError
from tests.export_problems import (
    assert_same_cameras,
    hard_reconstruction,
    moved,
    noise_images,
    numbers,
    seen_points,
    true_world_from_film,
)
from tests.exported_files import after_effects_tracks, exported, nuke_curves, nuke_nodes
from tests.video_files import moving_texture, write_video

Array = NDArray[np.float64]

HAND = 2.5  # a scale that no format has by default
PIXEL = 1e-6  # written as text or double
MAP_PIXEL = 2e-4  # read from a map of single precision


def degrees_about(axis: int, angle: float) -> Array:
    return cv2.Rodrigues(np.eye(3)[axis] * math.radians(angle))[0]


def pose(rotation: Array, center: Any) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, center
    return matrix


def in_film_camera(world_from_film: Array, points: Array) -> Array:
    return (points - world_from_film[:3, 3]) @ world_from_film[:3, :3]


# COLMAP


@pytest.mark.parametrize("format", ["colmap", "colmap-binary"])
@pytest.mark.parametrize("up_axis", ["-y", "z"])
def test_colmap_in_pycolmap(tmp_path: Path, format: str, up_axis: str) -> None:
    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "out", format=format, options=ExportOptions(up_axis=up_axis, scale=HAND))
    suffixes = {Path(name).suffix for name in exported(tmp_path / "out")}
    assert suffixes == {".txt" if format == "colmap" else ".bin"}
    model = pycolmap.Reconstruction(tmp_path / "out")
    (camera,) = model.cameras.values()
    np.testing.assert_array_equal(camera.params, reconstruction.camera.params)
    images = [model.image(frame.index + 1) for frame in reconstruction.registered]
    assert model.num_reg_images() == len(images)
    found = np.array([np.vstack([i.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]) for i in images])
    assert_same_cameras(found @ np.diag([1, -1, -1, 1]), true_world_from_film(reconstruction, up_axis, HAND))
    points = np.array([model.point3D(i).xyz for i in sorted(model.points3D)])
    np.testing.assert_allclose(points, moved(reconstruction.points, up_axis, HAND), rtol=1e-12)


# Trajectories


def test_tum_in_evo(tmp_path: Path) -> None:
    from evo.tools import file_interface

    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "t.txt", format="tum")
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    assert trajectory.check()[0]
    np.testing.assert_allclose(trajectory.timestamps, [f.timestamp for f in reconstruction.registered], atol=1e-9)
    found = np.array(trajectory.poses_se3) @ np.diag([1, -1, -1, 1])
    assert_same_cameras(found, true_world_from_film(reconstruction, "-y", 1.0))


def test_tum_times_follow_a_given_frame_rate(tmp_path: Path) -> None:
    export(hard_reconstruction(), tmp_path / "t.txt", format="tum", options=ExportOptions(fps=20))
    np.testing.assert_allclose(np.loadtxt(tmp_path / "t.txt")[:, 0], [0.5, 0.6, 0.7, 0.9, 1.0], atol=1e-9)


def test_tum_times_follow_a_given_first_frame(tmp_path: Path) -> None:
    numbers = np.array([10, 12, 14, 18, 20])
    export(hard_reconstruction(), tmp_path / "t.txt", format="tum", options=ExportOptions(first_frame=500, fps=20))
    np.testing.assert_allclose(np.loadtxt(tmp_path / "t.txt")[:, 0], (500 + numbers) / 20, atol=1e-9)
    export(hard_reconstruction(), tmp_path / "t.txt", format="tum", options=ExportOptions(first_frame=0))
    times = np.loadtxt(tmp_path / "t.txt")[:, 0]
    timed = [frame.timestamp for frame in hard_reconstruction().registered]  # at 48 frames a second, from 0 on
    np.testing.assert_allclose(times, numbers / 48, atol=1e-9)
    assert np.abs(times - timed).min() > 0.1


@pytest.mark.parametrize(("options", "told"), [([], False), (["--fps", "25"], True), (["--first-frame", "0"], True)])
def test_tum_keeps_uneven_times_or_says_that_it_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], told: bool
) -> None:
    reconstruction = hard_reconstruction()
    for k, frame in enumerate(reconstruction.frames):
        frame.timestamp = 0.04 * frame.index + 0.04 * (k > 2)
    reconstruction.write(tmp_path / "result")
    command = ["export", str(tmp_path / "result"), "--format", "tum", "--output", str(tmp_path / "t.txt")]
    assert main([*command, *options]) == 0
    assert ("its frames come at uneven times" in capsys.readouterr().out) == told


def test_kitti_in_evo_and_the_gap(tmp_path: Path) -> None:
    from evo.tools import file_interface

    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "k.txt", format="kitti")
    rows = np.loadtxt(tmp_path / "k.txt")
    assert rows.shape == (6, 12)
    assert np.isnan(rows).all(axis=1).tolist() == [not f.registered for f in reconstruction.frames]
    np.savetxt(tmp_path / "registered.txt", rows[[0, 1, 2, 4, 5]], fmt="%.12g")
    poses = file_interface.read_kitti_poses_file(str(tmp_path / "registered.txt")).poses_se3
    assert_same_cameras(np.array(poses) @ np.diag([1, -1, -1, 1]), true_world_from_film(reconstruction, "-y", 1.0))


# nerfstudio: its documentation says OpenGL cameras (y up, looking along -z), and that the principal point is in
# pixels; its ray generator puts pixel centres at 0.5.


@pytest.mark.parametrize("up_axis", [None, "y"])
def test_nerfstudio_projects_as_pycolmap(tmp_path: Path, up_axis: str | None) -> None:
    reconstruction = hard_reconstruction()
    options = ExportOptions(up_axis=up_axis, scale=HAND)
    export(reconstruction, tmp_path / "out", format="nerfstudio", options=options)
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    axis = up_axis or "z"
    assert content["camera_model"] == "OPENCV"
    assert (content["w"], content["h"]) == (640, 480)
    assert [f["file_path"] for f in content["frames"]] == [
        f"images/{frame.name}.png" for frame in reconstruction.registered
    ]
    found = np.array([frame["transform_matrix"] for frame in content["frames"]])
    assert_same_cameras(found, true_world_from_film(reconstruction, axis, HAND))
    k1, k2, p1, p2 = (content[name] for name in ("k1", "k2", "p1", "p2"))
    matrix = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    for position, frame in enumerate(reconstruction.registered):
        points, _ = seen_points(reconstruction, position)
        in_camera = in_film_camera(found[position], moved(points, axis, HAND)) * [1, -1, -1]
        pixels, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, np.array([k1, k2, p1, p2]))
        truth = reconstruction.camera.img_from_cam(frame.cam_from_world * points)
        np.testing.assert_allclose(pixels[:, 0], truth, atol=PIXEL)
    applied = content["applied_scale"] * np.array(content["applied_transform"])[:, :3]
    np.testing.assert_allclose(reconstruction.points @ applied.T, moved(reconstruction.points, axis, HAND))
    assert content["ply_file_path"] == "points.ply"
    assert (tmp_path / "out" / "points.ply").exists()


def test_nerfstudio_copies_the_frames(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    footage = noise_images(tmp_path / "shot", 21)
    for frame in reconstruction.frames:
        frame.name = f"shot.{1001 + frame.index:04d}.png"
    export(reconstruction, tmp_path / "out", format="nerfstudio", options=ExportOptions(footage=footage))
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for frame, entry in zip(reconstruction.registered, content["frames"], strict=True):
        assert (tmp_path / "out" / entry["file_path"]).read_bytes() == (footage / frame.name).read_bytes()
    assert len(list((tmp_path / "out" / "images").iterdir())) == 5


def test_nerfstudio_refuses_what_it_cannot_hold(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    reconstruction.camera = pycolmap.Camera(model="FOV", width=640, height=480, params=[600, 640, 290, 262, 0.3])
    with pytest.raises(InputError, match="does not know the lens model FOV"):
        export(reconstruction, tmp_path / "out", format="nerfstudio")
    assert not list(tmp_path.iterdir())
    footage = noise_images(tmp_path / "shot", 15)
    with pytest.raises(InputError, match="lacks frame 1019"):
        export(hard_reconstruction(), tmp_path / "out", format="nerfstudio", options=ExportOptions(footage=footage))
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


# Nuke: rotation order ZXY turns about z first; the projection follows the matrices that Nuke's own scripts use
# (nukescripts.snap3d): window translation and scale act on coordinates that run from -1 to 1 over the width, and lines
# are as far apart as the pixel aspect of the format says.


def nuke_aspect(node: dict[str, Any]) -> float:
    return float(node["format"].strip('"').split()[6])


def nuke_pixels(camera: dict[str, Any], world_from_film: Array, points: Array, aspect: float) -> Array:
    x, y, z = in_film_camera(world_from_film, points).T
    window = 2 * camera["focal"] / camera["haperture"] * np.column_stack([x, y]) / -z[:, None]
    window = (window - camera["win_translate"]) / camera["win_scale"]
    width, height = 640, 480
    return np.column_stack([(window[:, 0] + 1) * width / 2, height - (window[:, 1] * aspect * width / 2 + height / 2)])


def nuke_rotation(x: float, y: float, z: float) -> Array:
    return degrees_about(1, y) @ degrees_about(0, x) @ degrees_about(2, z)


def test_nuke_script_projects_as_pycolmap(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    options = ExportOptions(scale=HAND, sensor_width=24.89, fps=25, first_frame=101)
    export(reconstruction, tmp_path / "out", format="nuke", options=options)
    assert exported(tmp_path / "out") == {"camera.nk", "points.obj", "undistort.exr", "distort.exr"}
    nodes = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())
    root, camera = nodes["Root"], nodes["Camera"]
    assert (root["first_frame"], root["last_frame"], root["fps"]) == ("111", "121", "25")
    assert root["format"].strip('"').split()[:6] == ["640", "480", "0", "0", "640", "480"]
    assert nuke_aspect(root) == nuke_aspect(nodes["Plate"]) == pytest.approx(1200 / 600, abs=1e-9)
    assert nodes["NotRegistered"]["label"] == '"No camera at frames 117"'
    assert (camera["class"], camera["rot_order"]) == ("Camera2", "ZXY")
    assert float(camera["focal"]) == pytest.approx(600 * 24.89 / 640, rel=1e-9)
    assert float(camera["vaperture"]) == pytest.approx(480 * 600 / 1200 * 24.89 / 640, rel=1e-9)
    knobs = {name: float(camera[name]) for name in ("focal", "haperture", "near", "far")}
    knobs |= {name: np.array(camera[name].strip("{}").split(), float) for name in ("win_translate", "win_scale")}
    translate, rotate = nuke_curves(camera["translate"]), nuke_curves(camera["rotate"])
    assert list(translate) == list(rotate) == numbers(reconstruction, 101)
    found = np.array([pose(nuke_rotation(*rotate[frame]), translate[frame]) for frame in translate])
    assert_same_cameras(found, true_world_from_film(reconstruction, "y", HAND))
    for position in range(5):
        points, pixels = seen_points(reconstruction, position)
        projected = nuke_pixels(knobs, found[position], moved(points, "y", HAND), nuke_aspect(root))
        np.testing.assert_allclose(projected, pixels, atol=PIXEL)


def test_nuke_angles_do_not_jump(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    for k, frame in enumerate(reconstruction.registered):
        rotation = pycolmap.Rotation3d(np.array([0.0, -1.0, 0.0]) * k)  # a pan over a full turn and more
        frame.cam_from_world = pycolmap.Rigid3d(rotation, np.zeros(3))
    export(reconstruction, tmp_path / "c.chan", format="chan")
    pan = np.loadtxt(tmp_path / "c.chan")[:, 5]
    np.testing.assert_allclose(np.abs(np.diff(pan)), math.degrees(1), atol=1e-6)


def test_nuke_script_wiring(tmp_path: Path) -> None:
    """Runs the script's stack: what is pushed last is input 0."""
    footage = noise_images(tmp_path / "shot", 30)
    options = ExportOptions(footage=footage)
    export(hard_reconstruction(), tmp_path / "bent", format="nuke", options=options)
    export(hard_reconstruction("PINHOLE"), tmp_path / "straight", format="nuke", options=options)
    bent, straight = (nuke_inputs((tmp_path / name / "camera.nk").read_text()) for name in ("bent", "straight"))
    assert bent == {
        "Undistort": ["Plate", "Map_undistort"],
        "PointsOnUndistortedPlate": ["Undistort", "Points", "Camera"],
        "RenderPoints": [None, "Points", "Camera"],
        "Distort": ["RenderPoints", "Map_distort"],
        "PointsOnPlate": ["Plate", "Distort"],
    }
    assert straight == {"PointsOnUndistortedPlate": ["Plate", "Points", "Camera"]}
    assert exported(tmp_path / "straight") == {"camera.nk", "points.obj"}
    plate = nuke_nodes((tmp_path / "bent" / "camera.nk").read_text())["Plate"]
    assert plate["file"] == f'"{footage.as_posix()}/shot.%04d.png"'
    assert (plate["first"], plate["last"]) == ("1001", "1030")
    assert (plate["frame_mode"], plate["frame"]) == ('"start at"', "1001")


def nuke_inputs(text: str) -> dict[str, list[str | None]]:
    stack: list[str | None] = []
    names: dict[str, str | None] = {}
    inputs = {}
    for kind, body, push, name in re.findall(
        r"^(\w+) \{\n(.*?)^\}$|^push (\S+)$|^set (\w+) \[stack 0\]$", text, re.MULTILINE | re.DOTALL
    ):
        if push:
            stack.append(None if push == "0" else names[push[1:]])
        elif name:
            names[name] = stack[-1]
        elif kind != "Root":
            knobs = dict(line[1:].split(" ", 1) for line in body.splitlines())
            found = [stack.pop() for _ in range(int(knobs["inputs"]))]
            if found:
                inputs[knobs["name"]] = found
            stack.append(knobs["name"])
    return inputs


def test_nuke_points_are_the_middles_of_the_tetrahedra(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction("PINHOLE")
    export(reconstruction, tmp_path / "out", format="nuke", options=ExportOptions(scale=HAND))
    lines = [line.split() for line in (tmp_path / "out" / "points.obj").read_text().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
    faces = np.array([line[1:] for line in lines if line[0] == "f"], int).reshape(40, 4, 3) - 1
    middles = vertices[faces].mean(axis=(1, 2))
    np.testing.assert_allclose(middles, moved(reconstruction.points, "y", HAND), atol=1e-6)
    a, b, c = np.moveaxis(vertices[faces], 2, 0)
    outwards = np.einsum("ijk,ijk->ij", np.cross(b - a, c - a), a - middles[:, None])
    assert (outwards > 0).all()


# After Effects: y down, z into the picture, orientation about z first, then y, then x, all right-handed in these
# axes; a camera of zoom z shows at distance z everything at 100 percent, in the middle of the composition.


def test_after_effects_projects_as_pycolmap(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "out", format="after-effects", options=ExportOptions(fps=23.976))
    assert b"\r\n" in (tmp_path / "out" / "camera.txt").read_bytes()
    header, tracks = after_effects_tracks((tmp_path / "out" / "camera.txt").read_text())
    assert header == {
        "Units Per Second": "23.976",
        "Source Width": "640",
        "Source Height": "480",
        "Source Pixel Aspect Ratio": "1",
        "Comp Pixel Aspect Ratio": "1",
    }
    _, footage = after_effects_tracks((tmp_path / "out" / "footage.txt").read_text())
    (anchor,), (place,), (percent,) = (
        footage[f"Transform\t{name}"].values() for name in ("Anchor Point", "Position", "Scale")
    )
    frames = numbers(reconstruction, 0)
    assert all(list(track) == frames for track in tracks.values())
    origin = np.array([320, 240, 0])
    found = []
    for position, frame in enumerate(frames):
        x, y, z = tracks["Transform\tOrientation"][frame]
        rotation = degrees_about(0, x) @ degrees_about(1, y) @ degrees_about(2, z)
        found.append(pose(rotation, tracks["Transform\tPosition"][frame] - origin))
        (zoom,) = tracks["Camera Options\tZoom"][frame]
        assert zoom == pytest.approx(600, rel=1e-9)
        points, pixels = seen_points(reconstruction, position)
        x, y, z = in_film_camera(found[-1], moved(points, "-y", 100.0)).T
        in_composition = zoom * np.column_stack([x, y]) / z[:, None] + origin[:2]
        layer = (pixels - anchor[:2]) * np.array(percent[:2]) / 100 + place[:2]
        np.testing.assert_allclose(in_composition, layer, atol=PIXEL)
    film = np.array(found) @ np.diag([1, -1, -1, 1])
    assert_same_cameras(film, true_world_from_film(reconstruction, "-y", 100.0))


# Blender, whose limits are those of its own properties; tests/export/test_blender.py runs the script in it


@pytest.mark.parametrize(
    ("rate", "whole"), [(0.001, 1), (0.4, 1), (0.5, 1), (1.4, 1), (30000 / 1001, 30), (1e6, 32767)]
)
def test_blender_takes_every_frame_rate(tmp_path: Path, rate: float, whole: int) -> None:
    export(hard_reconstruction(), tmp_path / "a.py", format="blender", options=ExportOptions(fps=rate))
    ((fps, base),) = re.findall(r'"fps": \[(\d+), ([^]]+)\]', (tmp_path / "a.py").read_text())
    assert int(fps) == whole
    assert int(fps) / float(base) == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"first_frame": -11}, "the numbers -1 to 9, and Blender has 0 to 1048574; another first frame"),
        ({"first_frame": 1048555}, "the numbers 1048565 to 1048575, and Blender has 0 to 1048574"),
        ({"sensor_width": 1.06}, "0.994 mm on a sensor of 1.06 mm, and Blender has 1 mm and more; a larger sensor"),
    ],
)
def test_blender_is_not_given_what_it_would_change(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        export(hard_reconstruction(), tmp_path / "a.py", format="blender", options=ExportOptions(**options))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{"first_frame": -10}, {"first_frame": 1048554}, {"sensor_width": 1.07}])
def test_blender_is_given_all_that_it_takes(tmp_path: Path, options: dict[str, Any]) -> None:
    export(hard_reconstruction(), tmp_path / "a.py", format="blender", options=ExportOptions(**options))
    assert (tmp_path / "a.py").exists()


# USD and Alembic


@pytest.mark.parametrize(
    ("up_axis", "scale", "suffix"), [(None, None, ".usda"), ("z", 1.0, ".usdc"), ("y", HAND, ".usd")]
)
def test_usd_in_usd_core(tmp_path: Path, up_axis: str | None, scale: float | None, suffix: str) -> None:
    pxr = pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    from pxr import Gf, Usd, UsdGeom, UsdValidation

    assert pxr
    reconstruction = hard_reconstruction()
    path = tmp_path / f"shot{suffix}"
    export(reconstruction, path, format="usd", options=ExportOptions(up_axis=up_axis, scale=scale, fps=25))
    assert path.read_bytes()[:5] == (b"#usda" if suffix == ".usda" else b"PXR-U")
    stage = Usd.Stage.Open(str(path))
    axis, scale = up_axis or "y", scale or 100.0
    assert UsdGeom.GetStageUpAxis(stage) == axis.upper()
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(1 / scale)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (1011, 1021, 25)
    assert list(stage.GetMetadata("customLayerData")["notRegistered"]) == [1017]
    assert stage.GetDefaultPrim().GetPath() == "/factorsfm"
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/factorsfm/camera"))
    frames = numbers(reconstruction, 1001)
    assert camera.GetPrim().GetAttribute("xformOp:transform").GetTimeSamples() == frames
    found = []
    for position, frame in enumerate(frames):
        gf_camera = camera.GetCamera(Usd.TimeCode(frame))
        found.append(np.array(gf_camera.transform).T)
        frustum = gf_camera.frustum
        points, pixels = seen_points(reconstruction, position)
        to_window = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        window = np.array([to_window.Transform(Gf.Vec3d(*map(float, p))) for p in moved(points, axis, scale)])
        np.testing.assert_allclose((window[:, 0] + 1) * 320, pixels[:, 0], atol=5e-5)
        np.testing.assert_allclose((1 - window[:, 1]) * 240, pixels[:, 1], atol=5e-5)
        # In mm, whatever the stage's unit: USD counts in tenths of it.
        to_mm = 100 * UsdGeom.GetStageMetersPerUnit(stage)
        assert gf_camera.focalLength * to_mm == pytest.approx(600 * 36 / 640, rel=1e-6)
        assert gf_camera.horizontalAperture * to_mm == pytest.approx(36, rel=1e-6)
    assert_same_cameras(np.array(found), true_world_from_film(reconstruction, axis, scale))
    points = UsdGeom.Points(stage.GetPrimAtPath("/factorsfm/points"))
    np.testing.assert_allclose(points.GetPointsAttr().Get(), moved(reconstruction.points, axis, scale), rtol=1e-6)
    colors = np.array(points.GetDisplayColorPrimvar().Get())
    srgb = [Gf.ConvertLinearToDisplay(Gf.Vec3f(*map(float, color))) for color in colors]  # a plain gamma of 2.2
    np.testing.assert_allclose(srgb, reconstruction.colors / 255, atol=0.04)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert validators
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []


def test_usd_refuses_what_a_stage_cannot_have(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    with pytest.raises(InputError, match=r"out\.abc ends in none of \.usd"):
        export(hard_reconstruction(), tmp_path / "out.abc", format="usd")
    with pytest.raises(InputError, match="is y or z, not -y"):
        export(hard_reconstruction(), tmp_path / "out.usd", format="usd", options=ExportOptions(up_axis="-y"))
    assert not list(tmp_path.iterdir())


def test_alembic_in_alembic(tmp_path: Path) -> None:
    pytest.importorskip("alembic3d", reason="alembic3d (extra alembic) is not installed")
    from alembic3d.Abc import IArchive, ISampleSelector
    from alembic3d.AbcGeom import ICamera, IPoints, IXform

    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "shot.abc", format="alembic", options=ExportOptions(fps=25, scale=HAND))
    archive = IArchive(str(tmp_path / "shot.abc"))
    transform = IXform(archive.getTop(), "camera")
    schema = transform.getSchema()
    frames = numbers(reconstruction, 1001)
    assert schema.getNumSamples() == len(frames)
    times = [schema.getTimeSampling().getSampleTime(i) for i in range(len(frames))]
    np.testing.assert_allclose(times, np.array(frames) / 25, rtol=1e-12)
    matrices = [schema.getValue(ISampleSelector(time)).getMatrix() for time in times]
    found = np.array([[[m[row][column] for row in range(4)] for column in range(4)] for m in matrices])
    assert_same_cameras(found, true_world_from_film(reconstruction, "y", HAND))
    lens = ICamera(transform, "cameraShape").getSchema().getValue(ISampleSelector(0))
    assert lens.getFocalLength() == pytest.approx(600 * 36 / 640, rel=1e-9)
    assert lens.getHorizontalAperture() == pytest.approx(3.6, rel=1e-9)
    aperture = np.array([lens.getHorizontalAperture(), lens.getVerticalAperture()])
    offset = np.array([lens.getHorizontalFilmOffset(), lens.getVerticalFilmOffset()])
    for position in range(5):
        points, pixels = seen_points(reconstruction, position)
        x, y, z = in_film_camera(found[position], moved(points, "y", HAND)).T
        on_film = lens.getFocalLength() / 10 * np.column_stack([x, y]) / -z[:, None]  # cm
        share = (on_film - offset) / aperture + 0.5  # of the film back from its bottom left corner
        np.testing.assert_allclose(share * [640, -480] + [0, 480], pixels, atol=PIXEL)
    positions = IPoints(archive.getTop(), "points").getSchema().getValue().getPositions()
    np.testing.assert_allclose([list(p) for p in positions], moved(reconstruction.points, "y", HAND), rtol=1e-6)


# The lens


def read_exr(path: Path) -> NDArray[np.float32]:
    image_io = pytest.importorskip("OpenImageIO", reason="OpenImageIO, which reads the maps back, is not installed")
    buffer = image_io.ImageBuf(str(path))
    assert not buffer.has_error, buffer.geterror()
    assert str(buffer.spec().format) == "float"
    assert tuple(buffer.spec().channelnames) == ("R", "G", "B")
    return np.asarray(buffer.get_pixels(image_io.FLOAT))


def test_stmaps_in_openimageio(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    camera = reconstruction.camera
    export(reconstruction, tmp_path / "out", format="stmap")
    undistort, distort = (read_exr(tmp_path / "out" / f"{name}.exr") for name in ("undistort", "distort"))
    matrix = np.array([[600, 0, 290], [0, 1200, 262], [0, 0, 1]], float)  # principal point from the corner
    corners = np.stack(np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5), axis=-1)
    for found in (undistort, distort):
        assert found.shape == (480, 640, 3)
        assert (found[..., 2] == 0).all()
    # OpenCV knows the same model: a pixel of the straight image is at this place of the bent one.
    rays = np.dstack([(corners - matrix[:2, 2]) / [600, 1200], np.ones((480, 640))]).reshape(-1, 3)
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, camera.params[4:])
    places = np.dstack([undistort[..., 0] * 640, (1 - undistort[..., 1]) * 480])
    np.testing.assert_allclose(places.reshape(-1, 2), bent[:, 0], atol=MAP_PIXEL)
    # and back
    places = np.dstack([distort[..., 0] * 640, (1 - distort[..., 1]) * 480]).reshape(-1, 2)
    rays = np.column_stack([(places - matrix[:2, 2]) / [600, 1200], np.ones(len(places))])
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, camera.params[4:])
    np.testing.assert_allclose(bent[:, 0], corners.reshape(-1, 2), atol=MAP_PIXEL)


def test_stmaps_of_a_pinhole_change_nothing(tmp_path: Path) -> None:
    export(hard_reconstruction("PINHOLE"), tmp_path / "out", format="stmap")
    for name in ("undistort", "distort"):
        found = read_exr(tmp_path / "out" / f"{name}.exr")
        np.testing.assert_allclose(found[0, :, 0], (np.arange(640) + 0.5) / 640, atol=1e-6)
        np.testing.assert_allclose(found[:, 0, 1], 1 - (np.arange(480) + 0.5) / 480, atol=1e-6)


def test_stmap_says_where_a_lens_folds_back(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    # r (1 - 0.9 r²) has its maximum at r = 0.61; the corners are at 0.72
    reconstruction.camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=640, height=480, params=[555, 320, 240, -0.9])
    export(reconstruction, tmp_path / "out", format="stmap")
    undistort = read_exr(tmp_path / "out" / "undistort.exr")
    radius = np.hypot(*np.meshgrid((np.arange(640) - 319.5) / 555, (np.arange(480) - 239.5) / 555))
    assert (undistort[radius > 0.63][:, :2] == -1).all()
    assert (undistort[radius < 0.59][:, :2] > 0).all()


@pytest.mark.parametrize("movie", [False, True])
def test_undistorted_plates(tmp_path: Path, movie: bool) -> None:
    """The plates are what OpenCV's own undistortion makes of the footage."""
    reconstruction = hard_reconstruction()
    footage = noise_images(tmp_path / "shot", 3)
    originals = [cv2.imread(str(path)) for path in sorted(footage.iterdir())]
    if movie:
        footage = tmp_path / "shot.avi"
        writer = cv2.VideoWriter(str(footage), cv2.VideoWriter.fourcc(*"MJPG"), 24, (640, 480))
        for image in originals:
            writer.write(image)
        writer.release()
        capture = cv2.VideoCapture(str(footage))
        originals = [capture.read()[1] for _ in originals]
    options = ExportOptions(footage=footage, first_frame=1)
    export(reconstruction, tmp_path / "out", format="undistorted", options=options)
    plates = [tmp_path / "out" / name for name in sorted(exported(tmp_path / "out"))]
    assert [path.name for path in plates] == ["plate.0001.png", "plate.0002.png", "plate.0003.png"]
    matrix = np.array([[600, 0, 289.5], [0, 1200, 261.5], [0, 0, 1]], float)  # pixel centres at integers
    maps = cv2.initUndistortRectifyMap(
        matrix, reconstruction.camera.params[4:], np.eye(3), matrix, (640, 480), cv2.CV_32FC1
    )
    for path, original in zip(plates, originals, strict=True):
        expected = cv2.remap(original, *maps, cv2.INTER_CUBIC)
        difference = cv2.absdiff(cv2.imread(str(path)), expected)
        assert difference.max() <= 2
        assert cv2.absdiff(original, expected).mean() > 0.5


def test_undistorted_refuses_missing_and_wrong_footage(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no footage to undistort"):
        export(hard_reconstruction(), tmp_path / "out", format="undistorted")
    footage = noise_images(tmp_path / "shot", 1, width=320, height=240)
    source = hard_reconstruction(options={"source": str(footage)})
    with pytest.raises(InputError, match="has 320x240 pixels, the camera 640x480"):
        export(source, tmp_path / "out", format="undistorted")
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


# What all formats share


def path_of(format: str, folder: Path) -> Path:
    return folder / (f"out.{format}" if format != "usd" else "out.usda")


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_all_or_nothing_and_replaces_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str
) -> None:
    for module in {"usd": ["pxr"], "alembic": ["alembic3d"]}.get(format, []):
        pytest.importorskip(module)
    # nerfstudio wants all frames of the reconstruction
    options = ExportOptions(footage=noise_images(tmp_path / "shot", 21 if format == "nerfstudio" else 1))
    place = tmp_path / "place"
    path = path_of(format, place)
    for _ in range(2):
        export(hard_reconstruction(), path, format=format, options=options)
        assert [p.name for p in place.iterdir()] == [path.name]
        assert path.is_dir() == FORMATS[format].is_folder
    before = {p: p.read_bytes() for p in place.rglob("*") if p.is_file()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    broken = FORMATS[format].__class__("", full, FORMATS[format].is_folder)
    monkeypatch.setitem(FORMATS, format, broken)
    for target in (path, place / "new"):
        with pytest.raises(InputError, match=r"cannot write the output .*: No space left on device"):
            export(hard_reconstruction(), target, format=format, options=options)
    assert {p: p.read_bytes() for p in place.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("format", FORMATS)
def test_the_first_frame_counts_where_the_docs_say_so(tmp_path: Path, format: str) -> None:
    for module in {"usd": ["pxr"], "alembic": ["alembic3d"]}.get(format, []):
        pytest.importorskip(module)
    table = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    (said,) = re.findall(rf"^\| `{format}` \|.*\| (\S+) \|$", table, re.MULTILINE)
    footage = noise_images(tmp_path / "shot", 1) if format in ("undistorted", "tracks-blender") else None
    written, reconstruction = [], hard_reconstruction()
    if format == "stmap":  # one pair of maps has no number
        reconstruction.frames[0].camera = reconstruction.camera
    for first_frame in (0, 500):
        path = path_of(format, tmp_path / str(first_frame))
        options = ExportOptions(first_frame=first_frame, footage=footage)
        export(reconstruction, path, format=format, options=options)
        files = [file for file in sorted(path.parent.rglob("*")) if file.is_file()]
        written.append({file.relative_to(path.parent): file.read_bytes() for file in files})
    assert (written[0] != written[1]) == (said != "–")


@pytest.mark.parametrize(
    "name", ["../x.png", "a/../../x.png", "/x.png", "C:x.png", "c:\\x.png", "\\\\host\\x", "..\\x.png"]
)
def test_no_export_takes_a_name_that_leaves_the_folder(tmp_path: Path, name: str) -> None:
    reconstruction = hard_reconstruction()
    reconstruction.frames[1].name = name
    options = ExportOptions(footage=noise_images(tmp_path / "shot", 21))
    for format in FORMATS:
        with pytest.raises(InputError, match=r"the image name '.*' leaves the folder of the images"):
            export(reconstruction, tmp_path / "place" / "out", format=format, options=options)
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


def test_names_with_folders_are_exported_with_them(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    for frame in reconstruction.frames:
        frame.name = f"take 1/b/{frame.index:06d}"
    options = ExportOptions(footage=noise_images(tmp_path / "shot", 21))
    for format in ("nerfstudio", "colmap", "colmap-binary"):
        export(reconstruction, tmp_path / format, format=format, options=options)
    expected = [f"take 1/b/{frame.index:06d}.png" for frame in reconstruction.registered]
    images = tmp_path / "nerfstudio" / "images"
    assert sorted(str(path.relative_to(images)) for path in images.rglob("*.png")) == expected
    for format in ("colmap", "colmap-binary"):
        assert sorted(i.name for i in pycolmap.Reconstruction(tmp_path / format).images.values()) == expected


def test_an_error_while_an_export_is_replaced_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ExportOptions(footage=noise_images(tmp_path / "shot", 21))
    out, rename, renames = tmp_path / "out", Path.replace, []
    export(hard_reconstruction(), out, format="nerfstudio", options=options)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    def failing_after(most: int) -> Callable[[Path, Path], Path]:
        renames.clear()

        def renamed(source: Path, target: Path) -> Path:
            renames.append(target)
            if len(renames) == most + 1:
                raise OSError(5, "Input/output error")
            return rename(source, target)

        return renamed

    for most in range(8):  # transforms.json, points.ply and images/, each out and in, and the list before and after
        monkeypatch.setattr(Path, "replace", failing_after(most))
        with pytest.raises(InputError, match="Input/output error"):
            export(hard_reconstruction(), out, format="nerfstudio", options=options)
        assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    monkeypatch.setattr(Path, "replace", failing_after(8))
    export(hard_reconstruction(), out, format="nerfstudio", options=options)
    assert len(renames) == 8


def test_output_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "mine.txt").write_text("x")
    with pytest.raises(InputError, match=r"holds something else \(mine\.txt\)"):
        export(hard_reconstruction(), folder, format="colmap")
    with pytest.raises(InputError, match="is a folder; this format is one file"):
        export(hard_reconstruction(), folder, format="ply")
    with pytest.raises(InputError, match="is a file; this format is a folder"):
        export(hard_reconstruction(), folder / "mine.txt", format="colmap")
    assert [(p.name, p.read_text()) for p in folder.iterdir()] == [("mine.txt", "x")]


@pytest.mark.parametrize("format", ["ply", "colmap"])
def test_output_that_is_neither_file_nor_folder_is_left_alone(tmp_path: Path, format: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, target in (("to_pipe", "pipe"), ("to_nothing", "absent"), ("to_itself", "to_itself")):
        (tmp_path / name).symlink_to(target)
    before = {path.name: path.lstat().st_mode for path in tmp_path.iterdir()}
    for name, kind in (("pipe", "pipe"), ("to_pipe", "pipe"), ("to_nothing", "link"), ("to_itself", "link")):
        with pytest.raises(InputError, match=rf"{name}:? (it )?is a {kind}.*(file is expected|format is a folder)$"):
            export(hard_reconstruction(), tmp_path / name, format=format)
        assert {path.name: path.lstat().st_mode for path in tmp_path.iterdir()} == before


def test_output_at_a_link_is_where_it_leads_to(tmp_path: Path) -> None:
    export(hard_reconstruction(), tmp_path / "expected", format="tum")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("an earlier one")
    for name, target in (("to_file", "folder/file"), ("to_folder", "folder")):
        (tmp_path / name).symlink_to(target)
    export(hard_reconstruction(), tmp_path / "to_file", format="tum")
    assert (tmp_path / "to_file").readlink() == Path("folder/file")
    assert (tmp_path / "folder" / "file").read_bytes() == (tmp_path / "expected").read_bytes()
    (tmp_path / "folder" / "file").unlink()
    export(hard_reconstruction(), tmp_path / "to_folder", format="colmap")
    assert (tmp_path / "to_folder").readlink() == Path("folder")
    assert pycolmap.Reconstruction(tmp_path / "folder").num_reg_images() == 5


def test_footage_must_be_a_numbered_sequence_or_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    footage = noise_images(tmp_path / "shot", 21)
    (footage / "shot.1005.png").rename(footage / "other.1005.png")
    with pytest.raises(InputError, match=r"holds other\.1005\.png beside the sequence shot"):
        export(hard_reconstruction(), tmp_path / "a", format="blender", options=ExportOptions(footage=footage))
    reconstruction = hard_reconstruction("PINHOLE", options={"source": str(footage)})
    export(reconstruction, tmp_path / "b", format="nuke")
    assert "there is no plate" in caplog.text
    assert nuke_nodes((tmp_path / "b" / "camera.nk").read_text())["Plate"]["class"] == "Constant"


def test_source_is_the_footage_where_none_is_given(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    footage = write_video(tmp_path / "a [1] $x.mp4", moving_texture(21))
    export(hard_reconstruction(options={"source": str(footage)}), tmp_path / "out", format="nuke")
    plate = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())["Plate"]
    assert plate["file"] == '"' + str(footage).replace("[", r"\[").replace("$", r"\$") + '"'
    assert (plate["first"], plate["last"], plate["frame"]) == ("1", "21", "1001")
    assert caplog.text == ""  # the script undistorts it
    export(hard_reconstruction(options={"source": str(footage)}), tmp_path / "out.py", format="blender")
    assert "the lens distorts" in caplog.text


@pytest.mark.parametrize("format", ["nuke", "blender"])
def test_footage_that_has_gone_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture, format: str) -> None:
    gone = tmp_path / "gone.mp4"
    export(hard_reconstruction(options={"source": str(gone)}), tmp_path / "out", format=format)
    assert f"the footage {gone} is not where it was, and no plate is written; --footage says where" in caplog.text


def test_frames_that_were_added_from_elsewhere_are_not_in_the_footage(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    footage = write_video(tmp_path / "shot.mp4", moving_texture(15))
    options = {"source": str(footage), "added": [{"source": str(tmp_path / "stills"), "first": 15}]}
    export(hard_reconstruction(options=options), tmp_path / "out", format="nuke")
    nodes = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())
    assert (nodes["Plate"]["first"], nodes["Plate"]["last"]) == ("1", "15")
    assert nodes["Root"]["last_frame"] == "1021"
    assert "of the frames of the result; it lacks" not in caplog.text


def test_a_source_that_cannot_be_decoded_is_no_plate(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    footage = tmp_path / "shot.mp4"
    footage.write_bytes(b"no video")
    for options, format in ((None, "nuke"), (None, "blender"), (ExportOptions(footage=footage), "nuke")):
        result = hard_reconstruction("PINHOLE", options={"source": str(footage)})
        if options is not None:
            with pytest.raises(InputError, match=r"shot\.mp4 cannot be decoded as a video"):
                export(result, tmp_path / "refused", format=format, options=options)
        else:
            export(result, tmp_path / format, format=format)
            (message,) = caplog.messages
            assert message.startswith(f"there is no plate: {footage} cannot be decoded as a video")
            caplog.clear()
    assert nuke_nodes((tmp_path / "nuke" / "camera.nk").read_text())["Plate"]["class"] == "Constant"
    assert {path.name for path in tmp_path.iterdir()} == {"shot.mp4", "nuke", "blender"}


def test_output_can_be_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        export(hard_reconstruction(), ".", format="colmap")
    assert exported(tmp_path) == {"cameras.txt", "images.txt", "points3D.txt"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0}, "fps is 0; a number from 0.001 to 1e\\+06"),
        ({"fps": math.nan}, "fps is nan; a number from"),
        ({"fps": "24"}, "fps is '24'; a number from"),
        ({"first_frame": 10.5}, "first_frame is 10.5; a whole number is expected"),
        ({"sensor_width": -36}, "sensor_width is -36; a number from"),
        ({"scale": math.inf}, "scale is inf; a number from"),
        ({"scale": 1e10}, r"scale is 1e\+10; a number from 1e-09 to 1e\+09 \(a length\) is expected"),
        ({"first_frame": 10**30}, r"first_frame is 1e\+30; a number from"),
        ({"up_axis": "x"}, 'up_axis is "x"; one of y, z, -y is expected'),
        ({"footage": "no/such/file"}, "the footage no/such/file does not exist"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ExportOptions(**options)


def test_unknown_format_and_nothing_registered(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='"fbx" is no export format; the formats are colmap, '):
        export(hard_reconstruction(), tmp_path / "x", format="fbx")
    reconstruction = hard_reconstruction()
    for frame in reconstruction.frames:
        frame.cam_from_world = None
    with pytest.raises(InputError, match="no frame is registered"):
        export(reconstruction, tmp_path / "x", format="ply")


@pytest.mark.parametrize(
    ("format", "module", "extra"),
    [("usd", "pxr.Gf", "vfx"), ("alembic", "alembic3d.Abc", "alembic")],
)
def test_missing_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str, module: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"needs the package \w+: pip install 'factorsfm\[{extra}\]'"):
        export(hard_reconstruction(), path_of(format, tmp_path), format=format)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("rate", "expected"), [(24000 / 1001, 24000 / 1001), (25, 25), (29.97, 30000 / 1001), (17.3, 17.3)]
)
def test_frame_rate_of_the_source(tmp_path: Path, rate: float, expected: float) -> None:
    reconstruction = hard_reconstruction()
    for frame in reconstruction.frames:
        frame.timestamp = round(frame.index / rate, 6)
    export(reconstruction, tmp_path / "out", format="after-effects")
    header, _ = after_effects_tracks((tmp_path / "out" / "camera.txt").read_text())
    assert float(header["Units Per Second"]) == pytest.approx(expected, rel=1e-5)
    for frame in reconstruction.frames:
        frame.timestamp = None
    export(reconstruction, tmp_path / "untimed", format="after-effects")
    header, _ = after_effects_tracks((tmp_path / "untimed" / "camera.txt").read_text())
    assert header["Units Per Second"] == "24"


@pytest.mark.parametrize(
    "moved_times",
    [
        lambda times: np.where(np.arange(len(times)) < len(times) // 2, times, times + 10.0),  # a pause
        lambda times: np.where(np.arange(len(times)) < len(times) // 2, times, times - times[len(times) // 2]),
        lambda times: np.where(np.arange(len(times)) < len(times) - 1, times, times + 1 / 24),  # one was left out
    ],
    ids=["pause", "jump back", "gap"],
)
def test_frame_rate_is_that_of_the_usual_steps(tmp_path: Path, moved_times: Callable[[Array], Array]) -> None:
    reconstruction = hard_reconstruction()
    times = moved_times(np.array([frame.index / 24 for frame in reconstruction.frames]))
    for frame, time in zip(reconstruction.frames, times, strict=True):
        frame.timestamp = round(float(time), 3)
    export(reconstruction, tmp_path / "out", format="after-effects")
    header, _ = after_effects_tracks((tmp_path / "out" / "camera.txt").read_text())
    assert header["Units Per Second"] == "24"


def test_import_is_light() -> None:
    """The command line does not wait for the extras' packages, nor for what plates alone need."""
    code = "import sys, factorsfm.cli; print([m for m in ('pxr', 'OpenEXR', 'alembic3d') if m in sys.modules])"
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
