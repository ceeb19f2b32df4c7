"""Cameras that other programs have tracked, as control: each file written by its own tool or by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.control.files import read_control
from factorsfm.control.known import Control, KnownDistance, KnownPose, MarkedPoint
from factorsfm.control.located import find_frames
from factorsfm.export import ExportOptions, export
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from tests.blender_files import in_blender, saved
from tests.export_problems import hard_reconstruction

Array = NDArray[np.float64]

FRAMES = [10, 12, 14, 18, 20]  # of the result


def assert_poses(control: Control, reconstruction: Reconstruction, keys: list[Any]) -> None:
    """The poses of the registered frames, in the world of the result."""
    assert [pose.frame for pose in control.poses] == keys
    centers = np.array([pose.position for pose in control.poses])
    np.testing.assert_allclose(centers, reconstruction.camera_centers(), atol=1e-5)
    size = np.linalg.norm(np.ptp(centers, axis=0))
    for pose, frame in zip(control.poses, reconstruction.registered, strict=True):
        assert pose.sigma == pytest.approx(0.01 * size, rel=1e-4)
        assert pose.rotation_sigma == 0.5
        given = pycolmap.Rotation3d(np.asarray(pose.cam_from_world))
        assert (given * frame.cam_from_world.rotation.inverse()).angle() < 1e-6


@pytest.mark.parametrize(
    ("format", "name", "first"),
    [
        ("chan", "a.chan", 1001),
        ("usd", "a.usda", 1001),
        ("usd", "a.usdc", 1),
        ("colmap", "model", None),
        ("colmap-binary", "model", None),
        ("nerfstudio", "nerf", None),
        ("nerfstudio", "nerf/transforms.json", None),
    ],
)
def test_what_is_exported_comes_back_in_its_world(tmp_path: Path, format: str, name: str, first: int | None) -> None:
    if format == "usd":
        pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    reconstruction = hard_reconstruction()
    options = ExportOptions(first_frame=first)
    export(reconstruction, tmp_path / Path(name).parts[0], format=format, options=options)
    control = read_control(tmp_path / name)
    names = [f"{frame:06d}.png" for frame in FRAMES]
    assert_poses(control, reconstruction, FRAMES if first is not None else names)


@pytest.mark.parametrize("rate", [0.4, 24000 / 1001, 24.0])
def test_alembic_comes_back(tmp_path: Path, rate: float) -> None:
    """Every second frame, and a gap: the archive states the frame rate."""
    pytest.importorskip("alembic3d", reason="alembic3d (extra alembic) is not installed")
    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "a.abc", format="alembic", options=ExportOptions(fps=rate))
    assert_poses(read_control(tmp_path / "a.abc"), reconstruction, FRAMES)
    (tmp_path / "control.json").write_text(json.dumps({"cameras": {"file": "a.abc", "fps": 2 * rate}}))
    doubled = [1001 + pose.frame for pose in read_control(tmp_path / "control.json").poses]
    assert doubled == [2 * (1001 + frame) for frame in FRAMES]  # what is said counts


@in_blender
@pytest.mark.parametrize("first", [None, 1001])
def test_the_camera_of_a_file_of_blender_comes_back(first: int | None, tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    export(reconstruction, tmp_path / "scene.py", format="blender", options=ExportOptions(first_frame=first))
    scene = f"import runpy; runpy.run_path({str(tmp_path / 'scene.py')!r})"
    control = read_control(saved(tmp_path, scene))
    assert [pose.frame for pose in control.poses] == list(range(10, 21))
    solved = replace(control, poses=[pose for pose in control.poses if pose.frame in FRAMES])
    assert_poses(solved, reconstruction, FRAMES)


IN_A_RIG = """
scene, camera = bpy.context.scene, bpy.context.scene.camera
scene.frame_start, scene.frame_end = 1, 3
rig = bpy.data.objects.new("rig", None)
scene.collection.objects.link(rig)
rig.scale, rig.location, camera.parent = (2, 2, 2), (0, 0, 1), rig
camera.constraints.new("DAMPED_TRACK").target = bpy.data.objects["Cube"]
camera.constraints[0].track_axis = "TRACK_NEGATIVE_Z"
for number in (1, 2, 3):
    camera.location = (number, -4, 1)
    camera.keyframe_insert("location", frame=number)
"""


@in_blender
def test_a_camera_of_blender_is_where_parents_and_constraints_place_it(tmp_path: Path) -> None:
    poses = read_control(saved(tmp_path, IN_A_RIG)).poses
    assert [pose.frame for pose in poses] == [0, 1, 2]
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(pose.position, [2 * (k + 1), -3, -8], atol=1e-6)  # z of Blender is -y
        ahead = pycolmap.Rotation3d(np.asarray(pose.cam_from_world)).inverse() * np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(ahead, -np.array(pose.position) / np.linalg.norm(pose.position), atol=1e-6)


@in_blender
def test_a_file_of_blender_without_a_camera(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"shot\.blend: its scene has no camera"):
        read_control(saved(tmp_path, "bpy.context.scene.camera = None"))


def sampled(path: Path, times: list[float], rate: float | None) -> None:
    """An archive whose camera is at x = t at the time t."""
    abc = pytest.importorskip("alembic3d.Abc", reason="alembic3d (extra alembic) is not installed")
    import imath
    from alembic3d import AbcCoreAbstract, AbcGeom

    archive = abc.OArchive(str(path)) if rate is None else abc.CreateArchiveWithInfo(str(path), rate, "", "")
    moments = AbcCoreAbstract.TimeVector()
    for time in times:
        moments.append(time)
    kind = AbcCoreAbstract.TimeSamplingType(AbcCoreAbstract.AcyclicFlag.kAcyclic)
    transform = AbcGeom.OXform(
        archive.getTop(), "camera", archive.addTimeSampling(AbcCoreAbstract.TimeSampling(kind, moments))
    )
    AbcGeom.OCamera(transform, "shape").getSchema().set(AbcGeom.CameraSample())
    for time in times:
        sample = AbcGeom.XformSample()
        sample.setTranslation(imath.V3d(time, 0.0, 0.0))
        transform.getSchema().set(sample)


def test_alembic_between_frames_and_without_a_rate(tmp_path: Path) -> None:
    frames = np.arange(1, 5)
    sampled(tmp_path / "shutter.abc", np.ravel(frames[:, None] + [-0.25, 0.0, 0.25]) / 24, 24.0)
    poses = read_control(tmp_path / "shutter.abc").poses
    assert [pose.frame for pose in poses] == [0, 1, 2, 3]
    np.testing.assert_allclose([pose.position for pose in poses], [[k / 24, 0, 0] for k in frames], atol=1e-9)
    sampled(tmp_path / "silent.abc", (1001 + 2 * frames) / 24, None)
    silent = read_control(tmp_path / "silent.abc")
    with pytest.raises(InputError, match=r"can name the first_frame, and the fps of an Alembic archive$"):
        find_frames(silent, [(k, f"{k:06d}") for k in range(9)])
    (tmp_path / "control.json").write_text(json.dumps({"cameras": {"file": "silent.abc", "fps": 24}}))
    named = find_frames(read_control(tmp_path / "control.json"), [(k, f"{k:06d}") for k in range(9)])
    assert named == {2: 2, 4: 4, 6: 6, 8: 8}


def test_usd_of_another_unit_and_below_a_moving_parent(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="usd-core (extra vfx) is not installed")
    from pxr import Gf, UsdGeom

    stage = usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    dolly = UsdGeom.Xform.Define(stage, "/dolly").AddTranslateOp()
    camera = UsdGeom.Camera.Define(stage, "/dolly/camera")
    camera.AddScaleOp().Set(Gf.Vec3f(3, 3, 3))
    for frame in range(3):
        dolly.Set(Gf.Vec3d(100 * frame, 20, 170), 1001 + frame)
    stage.Save()
    poses = read_control(tmp_path / "a.usda").poses
    assert [pose.frame for pose in poses] == [0, 1, 2]
    # z up in the file: x right, y into the picture; a camera there looks down without being turned
    np.testing.assert_allclose([pose.position for pose in poses], [[k, -1.7, 0.2] for k in range(3)], atol=1e-9)
    down = pycolmap.Rotation3d(np.asarray(poses[0].cam_from_world)).matrix() @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(down, [0, 0, 1], atol=1e-9)
    UsdGeom.Camera.Define(stage, "/second")
    stage.Save()
    with pytest.raises(InputError, match="it holds 2 cameras"):
        read_control(tmp_path / "a.usda")


def chan(path: Path, first: int, count: int = 4) -> Path:
    """A camera that goes right and pans; y up, looking along -z."""
    lines = [f"{first + k} {0.5 * k} 1.5 0 0 {-10 * k} 0 40" for k in range(count)]
    path.write_text("# Nuke\n" + "\n".join(lines) + "\n")
    return path


def test_chan_by_hand(tmp_path: Path) -> None:
    poses = read_control(chan(tmp_path / "a.chan", 1)).poses
    assert [pose.frame for pose in poses] == [0, 1, 2, 3]
    np.testing.assert_allclose([pose.position for pose in poses], [[0.5 * k, -1.5, 0] for k in range(4)], atol=1e-12)
    turned = pycolmap.Rotation3d(np.asarray(poses[3].cam_from_world)).matrix()
    expected = cv2.Rodrigues(np.array([0, -math.radians(30), 0]))[0]  # 30 degrees to the right, y down
    np.testing.assert_allclose(turned, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("first", "first_number", "first_frame", "expected"),
    [
        (1001, None, None, 0),
        (1003, None, None, 2),  # a camera that begins late
        (7, None, None, 6),
        (0, None, None, 0),
        (101, None, 101, 0),
        (1043, 1043, None, 1043),  # a numbered sequence
        (1, 1043, 1, 1043),  # which the other program counts from 1
    ],
)
def test_numbers_of_a_timeline(
    tmp_path: Path, first: int, first_number: int | None, first_frame: int | None, expected: int
) -> None:
    chan(tmp_path / "a.chan", first)
    said = {"file": "a.chan", **({} if first_frame is None else {"first_frame": first_frame})}
    (tmp_path / "control.json").write_text(json.dumps({"cameras": said}))
    poses = read_control(tmp_path / "control.json", first_number).poses
    assert [pose.frame for pose in poses] == [expected + k for k in range(4)]


def test_a_control_file_can_say_how_well_it_is_known(tmp_path: Path) -> None:
    chan(tmp_path / "a.chan", 1001)
    distance = {"length": 1.5, "sigma": 0.01, "frames": [0, 3]}
    said = {"cameras": {"file": "a.chan", "sigma": 0.02, "rotation_sigma": 0.1}, "distances": [distance]}
    (tmp_path / "control.json").write_text(json.dumps(said))
    control = read_control(tmp_path / "control.json")
    assert {(pose.sigma, pose.rotation_sigma) for pose in control.poses} == {(0.02, 0.1)}
    assert len(control.distances) == 1


def test_what_is_left_out_has_no_say_in_how_well_the_rest_is_known(tmp_path: Path) -> None:
    path = chan(tmp_path / "a.chan", 1001, 30)
    near = read_control(path)
    far = "\n".join(f"{1101 + k} {1e4 * k} 5e3 0 0 0 0" for k in range(100))
    path.write_text(path.read_text() + far)
    control, frames = read_control(path), range(10, 20)
    explicit = KnownPose(15, [1, 2, 3], 0.7)
    mixed = Control([explicit, *(pose for pose in control.poses if pose.frame != 15)], spare=True).within(frames)
    assert mixed.poses[0] == explicit
    for poses, steps in (
        (near.poses, 29),
        (near.within(frames).poses, 9),
        (control.within(frames).poses, 9),
        (mixed.poses[1:], 9),
    ):
        np.testing.assert_allclose([pose.sigma for pose in poses], 0.01 * 0.5 * steps, rtol=1e-12)
    with pytest.raises(InputError, match="a single position leaves the scale open; give a distance"):
        near.within([15])


def test_of_samples_while_the_shutter_is_open_the_whole_frame_counts(tmp_path: Path) -> None:
    abc = pytest.importorskip("alembic3d.Abc", reason="alembic3d (extra alembic) is not installed")
    from alembic3d.AbcCoreAbstract import TimeSampling
    from alembic3d.AbcGeom import CameraSample, OCamera, OXform, XformSample
    from imath import M44d

    archive = abc.OArchive(str(tmp_path / "a.abc"))
    sampling = archive.addTimeSampling(TimeSampling(0.25 / 24, 1001 / 24 - 0.25 / 24))
    xform = OXform(archive.getTop(), "camera", sampling)
    for k in range(-1, 14):  # frames 1001 to 1004, and quarters of one beside them
        sample = XformSample()
        sample.setMatrix(M44d(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.25 * k, 0, 0, 1))
        xform.getSchema().set(sample)
    OCamera(xform, "shape").getSchema().set(CameraSample())
    del xform, archive
    (tmp_path / "control.json").write_text(json.dumps({"cameras": {"file": "a.abc", "fps": 24}}))
    poses = read_control(tmp_path / "control.json").poses
    assert [pose.frame for pose in poses] == [0, 1, 2, 3]
    np.testing.assert_allclose([pose.position for pose in poses], [[k, 0, 0] for k in range(4)], atol=1e-12)


def test_frames_that_the_source_does_not_have_are_left_out(tmp_path: Path) -> None:
    control = read_control(chan(tmp_path / "a.chan", 1001, 30))
    assert find_frames(control, [(k, f"{k:06d}") for k in range(5, 9)]) == {5: 0, 6: 1, 7: 2, 8: 3}
    with pytest.raises(InputError, match=r"none of the 30 poses, of frames 0 to 29, is of a frame of the source"):
        find_frames(control, [(k, f"{k:06d}") for k in range(100, 104)])


@pytest.mark.parametrize(
    ("kind", "frames"),
    [
        ("colmap", [(k, f"{k:06d}") for k in range(8, 22)]),  # a video: its images are 000010.png and so on
        ("nerfstudio", [(k, f"{k:06d}") for k in range(8, 22)]),
        ("colmap", [(k, f"plate.{k:06d}.exr") for k in range(8, 22)]),
        ("nerfstudio", [(k, f"plate.{k:06d}.exr") for k in range(8, 22)]),  # its images are plate.000010.png
    ],
)
def test_exports_name_the_frames_of_videos_and_plates(tmp_path: Path, kind: str, frames: list[tuple[int, str]]) -> None:
    reconstruction = hard_reconstruction()
    for frame in reconstruction.frames:
        frame.name = dict(frames)[frame.index]
    export(reconstruction, tmp_path / "out", format=kind)
    found = find_frames(read_control(tmp_path / "out"), frames)
    assert [*found.values()] == [frame - 8 for frame in FRAMES]


@pytest.mark.parametrize(
    ("key", "frames", "position"),
    [
        ("000012.png", [(11, "000011"), (12, "000012")], 1),
        ("12.png", [(11, "000011"), (12, "000012")], 1),
        ("0012.png", [(11, "000011"), (12, "000012")], None),  # perhaps the twelfth, which is 11
        ("1012.png", [(1011, "a.1011.exr"), (1012, "a.1012.exr")], 1),
        ("a.1012.png", [(1011, "a.1011.exr"), (1012, "a.1012.exr")], 1),
        ("a.1012", [(1011, "a.1011"), (1012, "a.1012")], 1),
        ("1.png", [(0, "bee.jpg"), (1, "cow.jpg")], None),  # a place among photographs is in no file name
        ("7.png", [(0, "7.jpg"), (7, "0.jpg")], 0),
        ("cow.png", [(0, "bee.jpg"), (1, "cow.jpg")], 1),
        ("cow.png", [(0, "cow.tif"), (1, "cow.jpg")], None),
        ("cow", [(0, "cow.tif"), (1, "cow.jpg")], None),
        ("left/cow.png", [(0, "bee.jpg"), (1, "cow.jpg")], None),
    ],
)
def test_names_with_another_suffix(key: str, frames: list[tuple[int, str]], position: int | None) -> None:
    control = Control(distances=[KnownDistance(1.0, 0.1, frames=(key, "other"))])
    frames = [*frames, (9999, "other")]
    if position is None:
        with pytest.raises(InputError, match=f"control: there is no frame '{key}' among the 3 frames"):
            find_frames(control, frames)
    else:
        assert find_frames(control, frames)[key] == position


def test_two_names_of_one_frame_are_refused() -> None:
    message = r"control: '000002\.png' and 2 are the same frame"
    frames = [(k, f"{k:06d}") for k in range(4)]
    pair: list[str | int] = ["000002.png", 2]
    with pytest.raises(InputError, match=message):
        find_frames(Control(distances=[KnownDistance(1.0, 0.1, frames=pair)]), frames)
    with pytest.raises(InputError, match=message):
        find_frames(Control([KnownPose(key, [0, 0, k], 0.1, [0, 0, 0, 1], 1) for k, key in enumerate(pair)]), frames)
    marks = MarkedPoint("A", {key: [1.0, 2.0] for key in pair})
    with pytest.raises(InputError, match=message):
        find_frames(Control(points=[marks], distances=[KnownDistance(1.0, 0.1, frames=(0, 1))]), frames)


def test_images_can_be_counted_otherwise(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    for k, frame in enumerate(reconstruction.frames):
        frame.name = f"img_{k + 1:04d}.png"
    export(reconstruction, tmp_path / "model", format="colmap")
    said = {"cameras": {"file": "model", "first_frame": 1}}
    (tmp_path / "control.json").write_text(json.dumps(said))
    for first_number, first in ((None, 0), (1001, 1001)):
        poses = read_control(tmp_path / "control.json", first_number).poses
        assert [pose.frame for pose in poses] == [first + k for k in (0, 1, 2, 4, 5)]
    reconstruction.frames[0].name = "slate.png"
    export(reconstruction, tmp_path / "model", format="colmap")
    with pytest.raises(InputError, match=r"its images, slate.png to img_0006.png, differ in more than a number"):
        read_control(tmp_path / "control.json")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.chan", "", "it holds no pose of a camera"),
        ("a.chan", "1 2 3\n", 'the line "1 2 3" is not "frame tx ty tz rx ry rz"'),
        ("a.chan", "1 0 0 0 0 0 0\n2 0 0 0 0 0 0\n", "stands still"),
        ("a.chan", "1 0 0 0 0 0 0\n2 0 nan 0 0 0 0\n", "is not finite"),
        ("a.chan", "1 0 0 0 0 0 0\n2 1 0 0 0 0 0\n1.0 2 0 0 0 0 0\n", 'frame "1" is there twice'),
        ("a.usda", "no stage", "it is no USD stage"),
        ("transforms.json", '{"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}', "transform_matrix of a is"),
        (
            "transforms.json",
            json.dumps({"frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}] * 2}),
            r'frame "a\.png" is there twice',
        ),
        ("control.json", '{"cameras": {"sigma": 1}}', "cameras"),
        ("control.json", '{"cameras": {"file": "none.chan"}}', "there is no file"),
        ("control.json", '{"cameras": {"file": "none.fbx"}}', "there is no file"),
    ],
)
def test_files_that_hold_no_camera_are_refused_in_one_sentence(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    if name.endswith("usda"):
        pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_control(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.999])
def test_a_binary_model_that_is_not_whole_is_refused(file: str, share: float, tmp_path: Path) -> None:
    export(hard_reconstruction(), tmp_path / "model", format="colmap-binary")
    path = tmp_path / "model" / f"{file}.bin"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=rf"{file}.bin of the COLMAP model in .* is not whole"):
        read_control(tmp_path / "model")


@pytest.mark.parametrize("count", [2**40, 2**64 - 1])
@pytest.mark.parametrize("file", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_count_without_an_end_is_refused(count: int, file: str, tmp_path: Path) -> None:
    export(hard_reconstruction(), tmp_path / "model", format="colmap-binary")
    path = tmp_path / "model" / f"{file}.bin"
    path.write_bytes(count.to_bytes(8, "little") + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{file}.bin of the COLMAP model in .* is not whole"):
        read_control(tmp_path / "model")


def test_a_folder_without_a_model(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither images.bin nor images.txt nor transforms.json"):
        read_control(tmp_path)
