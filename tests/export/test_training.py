"""Folders for trainers of splats: blobs drawn where the distorted camera sees points, found where pinholes see them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.cli.main import main
from factorsfm.export import ExportOptions, export
from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.result.moving import Moving, MovingStretch
from factorsfm.result.reconstruction import Reconstruction, RollingShutter
from factorsfm.support.errors import InputError
from tests.exact_result import build
from tests.export_problems import noise_images
from tests.exported_files import exported

Array = NDArray[np.float64]

PARAMS = [600.0, 640.0, 290.0, 262.0, 0.06, -0.03, 0.002, -0.001]
POINTS = np.array([[x, y, 4.5 + x * y] for x in (-1.2, -0.4, 0.4, 1.2) for y in (-0.9, 0.0, 0.9)])
MOVING = np.array([540.0, 330.0])  # pixels of the footage, in frame 10; it goes left, away from all blobs
FOUND_PX = 0.1  # the middle of a blob after interpolation
NONE = cv2.IMREAD_UNCHANGED


def blobs(places: Array, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(h, w, 3) smooth spots at (n, 2) pixels, centres at integers."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    spots = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18) for u, v in places]
    return np.repeat(np.rint(20 + 200 * np.sum(spots, axis=0))[..., None], 3, axis=2).astype(np.uint8)


def middle(image: NDArray[np.uint8], place: Array) -> Array:
    """The middle of the spot near a pixel."""
    u, v = np.rint(place).astype(int)
    y, x = np.mgrid[v - 9 : v + 10, u - 9 : u + 10]
    weight = image[v - 9 : v + 10, u - 9 : u + 10, 0].astype(float) - 20
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def stained(folder: Path, suffix: str = ".jpg") -> Reconstruction:
    """A result of a lens with distortion and pixels that are not square, and its footage; something moves."""
    result = build(frames=5, points=len(POINTS), unregistered=(3,))
    camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=PARAMS)
    folder.mkdir()
    frames, seen = [], []
    for frame in result.frames:
        frames.append(replace(frame, name=f"shot.{frame.index:04d}{suffix}"))
        pose = frame.cam_from_world or pycolmap.Rigid3d()
        seen.append(camera.img_from_cam(pose * POINTS) - 0.5)
        cv2.imwrite(str(folder / frames[-1].name), blobs(seen[-1], (640, 480)), [cv2.IMWRITE_JPEG_QUALITY, 100])
    xy = np.concatenate([MOVING + np.random.default_rng(k).uniform(-20, 20, (30, 2)) - [5 * k, 0] for k in range(5)])
    moving = Moving(
        (MovingStretch(10, 18, 0.3, 0.05),), np.repeat([f.index for f in frames], 30), np.tile(np.arange(30), 5), xy
    )
    options = {"source": str(folder), "first_number": 10}
    return replace(
        result, camera=camera, frames=frames, points=POINTS, observation_xy=np.concatenate(seen), moving=moving,
        options=options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return stained(tmp_path_factory.mktemp("stained") / "shot")


def assert_mask(mask: NDArray[np.uint8], resting: Array, moving: Array) -> None:
    """Black where something moves, white where points rest."""
    assert set(np.unique(mask)) == {0, 255}
    assert mask.ndim == 2
    assert all(mask[v, u] for u, v in np.rint(resting).astype(int))
    assert not any(mask[v, u] for u, v in np.rint(moving).astype(int))


@pytest.mark.parametrize("format", ["colmap", "colmap-binary"])
def test_colmap_folder_has_what_its_cameras_see(shot: Reconstruction, tmp_path: Path, format: str) -> None:
    export(shot, tmp_path / "out", format=format, options=ExportOptions(undistorted=True))
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model_name == "PINHOLE"
    assert camera.params[:2] == pytest.approx(PARAMS[:2])
    names = {image.name for image in model.images.values()}
    assert names == {frame.name for frame in shot.registered}
    assert {path.name for path in (tmp_path / "out" / "images").iterdir()} == names
    assert model.num_points3D() == len(POINTS)
    for image in model.images.values():
        pixels = cv2.imread(str(tmp_path / "out" / "images" / image.name), NONE)
        assert pixels.shape == (camera.height, camera.width, 3)
        seen = camera.img_from_cam(image.cam_from_world() * POINTS)
        np.testing.assert_allclose([p.xy for p in image.points2D], seen, atol=1e-5)
        for place in seen - 0.5:
            assert np.abs(middle(pixels, place) - place).max() < FOUND_PX
        assert pixels.min() > 5  # no empty rim
        mask = cv2.imread(str((tmp_path / "out" / "masks" / image.name).with_suffix(".png")), NONE)
        assert mask.shape == pixels.shape[:2]
        index = int(image.name[5:9])
        bent = shot.moving.xy[shot.moving.frame == index]
        rays = shot.camera.cam_from_img(bent + 0.5)
        assert_mask(mask, seen - 0.5, camera.img_from_cam(np.column_stack([rays, np.ones(30)])) - 0.5)


@pytest.mark.parametrize("undistorted", [True, False])
def test_nerfstudio_has_a_mask_for_every_image(shot: Reconstruction, tmp_path: Path, undistorted: bool) -> None:
    export(shot, tmp_path / "out", format="nerfstudio", options=ExportOptions(undistorted=undistorted))
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    lens = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    bent = np.array([content[name] for name in ("k1", "k2", "p1", "p2")])
    assert bent.any() != undistorted
    ply = np.frombuffer((tmp_path / "out" / "points.ply").read_bytes()[-15 * len(POINTS) :], "V15")
    points = np.array([np.frombuffer(row, "<f4", 3) for row in ply])
    for entry in content["frames"]:
        pixels = cv2.imread(str(tmp_path / "out" / entry["file_path"]), NONE)
        assert pixels.shape[:2] == (content["h"], content["w"])
        pose = np.linalg.inv(np.array(entry["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        in_camera = points @ pose[:3, :3].T + pose[:3, 3]
        seen = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), lens, bent)[0][:, 0] - 0.5
        for place in seen:
            assert np.abs(middle(pixels, place) - place).max() < FOUND_PX
        mask = cv2.imread(str(tmp_path / "out" / entry["mask_path"]), NONE)
        assert mask.shape == pixels.shape[:2]
        assert_mask(mask, seen, np.empty((0, 2)))


@pytest.mark.parametrize("several", [False, True])
def test_lenses_that_nerfstudio_does_not_take_are_undistorted(
    shot: Reconstruction, tmp_path: Path, several: bool
) -> None:
    if several:
        fisheye = pycolmap.Camera(model="OPENCV_FISHEYE", width=640, height=480, params=[*PARAMS[:4], 0, 0, 0, 0])
        lenses = [shot.camera, *(len(shot.frames) - 1) * [fisheye]]
        frames = [replace(frame, camera=lens) for frame, lens in zip(shot.frames, lenses, strict=True)]
        result = replace(shot, frames=frames)
        message = "takes lenses of one model, not OPENCV and OPENCV_FISHEYE together"
    else:
        full = pycolmap.Camera(model="FULL_OPENCV", width=640, height=480, params=[*PARAMS, 0.02, 0, 0, 0])
        result = replace(shot, camera=full)
        message = "does not know the lens model FULL_OPENCV; it knows .*, OPENCV_FISHEYE"
    with pytest.raises(InputError, match=f"{message}; --undistorted writes images without distortion"):
        export(result, tmp_path / "out", format="nerfstudio")
    assert not list(tmp_path.iterdir())
    export(result, tmp_path / "out", format="nerfstudio", options=ExportOptions(undistorted=True))
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    for lens in content["frames"] if several else [content]:
        assert [lens[name] for name in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
        assert (tmp_path / "out" / content["frames"][0]["file_path"]).exists()


def test_masks_that_are_given_and_objects_are_ignored_too(shot: Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    corner = np.zeros((48, 64), np.uint8)
    corner[44:, :4] = 255
    for frame in shot.frames:
        cv2.imwrite(str(tmp_path / "masks" / f"{frame.index:04d}.png"), corner)
    thing = np.array([[0.0, 0.45, 5.0]]) + np.random.default_rng(1).uniform(-0.05, 0.05, (30, 3))
    at = tuple(ObjectFrame(f.index, pycolmap.Rigid3d(), np.eye(6)) for f in shot.registered)
    car = ObjectResult("car", at, thing, np.zeros((30, 3), np.uint8), 0.1, None, None, "")
    export(
        replace(shot, objects=(car,)), tmp_path / "out", format="nerfstudio",
        options=ExportOptions(masks=tmp_path / "masks"),
    )  # fmt: skip
    for position, frame in enumerate(shot.frames):
        if frame.registered:
            mask = cv2.imread(str(tmp_path / "out" / "masks" / f"{Path(frame.name).stem}.png"), NONE)
            places = [shot.camera.img_from_cam(frame.cam_from_world * thing) - 0.5, [[10, 470], [35, 450]]]
            resting = shot.observation_xy[shot.observation_frame == position]
            assert_mask(mask, resting, np.concatenate([*places, shot.moving.xy[shot.moving.frame == frame.index]]))


def test_what_is_not_bent_is_copied_and_nothing_moving_has_no_masks(shot: Reconstruction, tmp_path: Path) -> None:
    straight = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=PARAMS[:4])
    result = replace(shot, camera=straight, moving=None)
    export(result, tmp_path / "out", format="colmap", options=ExportOptions(undistorted=True))
    for frame in shot.registered:
        copy = tmp_path / "out" / "images" / frame.name
        assert copy.read_bytes() == (Path(shot.options["source"]) / frame.name).read_bytes()
    assert exported(tmp_path / "out") == {"images", "sparse"}


def test_images_that_exif_data_turn_are_written_upright(tmp_path: Path) -> None:
    result = stained(tmp_path / "shot")
    path = tmp_path / "shot" / result.frames[0].name
    upright = cv2.imread(str(path))
    data = cv2.imencode(".jpg", cv2.rotate(upright, cv2.ROTATE_90_COUNTERCLOCKWISE))[1].tobytes()
    turn = b"\xff\xe1\x00\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    path.write_bytes(data[:2] + turn + data[2:])
    export(result, tmp_path / "out", format="nerfstudio")
    stored = cv2.imread(str(tmp_path / "out" / "images" / path.name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert stored.shape == upright.shape
    assert np.abs(stored.astype(float) - upright).mean() < 2


def photographs(folder: Path) -> Reconstruction:
    """Counted from 0; the second image is stored at half the size, and the third one was turned to the left."""
    result = stained(folder, ".png")
    frames = [replace(frame, index=k, name=f"{k}.png") for k, frame in enumerate(result.frames)]
    for k, frame in enumerate(result.frames):
        image = cv2.imread(str(folder / frame.name))
        (folder / frame.name).unlink()
        if k == 1:
            image = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
        if k == 2:
            image = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
        cv2.imwrite(str(folder / f"{k}.png"), image)
    straight = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=PARAMS[:4])
    options = {"source": str(folder), "unordered": True, "first_number": 0}
    return replace(result, frames=frames, camera=straight, moving=None, options=options)


@pytest.mark.parametrize("format", ["nerfstudio", "colmap"])
def test_photographs_of_several_sizes_are_written_as_they_were_solved(tmp_path: Path, format: str) -> None:
    result = photographs(tmp_path / "set")
    (tmp_path / "masks").mkdir()
    for frame in result.frames:
        mask = np.zeros(cv2.imread(str(tmp_path / "set" / frame.name)).shape[:2], np.uint8)
        mask[: len(mask) // 4] = 255  # ignored: what is above in the file
        cv2.imwrite(str(tmp_path / "masks" / frame.name), mask)
    options = ExportOptions(undistorted=format == "colmap", masks=tmp_path / "masks")
    export(result, tmp_path / "out", format=format, options=options)
    for frame in result.registered:
        image = cv2.imread(str(tmp_path / "out" / "images" / frame.name))
        assert image.shape == (480, 640, 3)
        seen = result.observation_xy[result.observation_frame == frame.index]
        assert all(np.linalg.norm(middle(image, place) - place) < 0.3 for place in seen)
        ignored = cv2.imread(str(tmp_path / "out" / "masks" / frame.name), NONE) == 0
        assert ignored.mean() == pytest.approx(0.25, abs=0.1)
        assert ignored[240, 5 if frame.index == 2 else 635] == (frame.index == 2)
        assert ignored[5, 320] == (frame.index != 2)


def test_photographs_of_several_sizes_or_numbers_of_their_own_are_no_plate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    result = photographs(tmp_path / "set")
    export(result, tmp_path / "a", format="nuke")
    assert caplog.messages == [
        "there is no plate: 1.png has 320x240 pixels and was solved as one of 640x480; a plate has images of one size"
    ]
    with pytest.raises(InputError, match="a plate has images of one size"):
        export(result, tmp_path / "b", format="blender", options=ExportOptions(footage=tmp_path / "set"))
    numbered = stained(tmp_path / "numbered")
    frames = [replace(frame, index=k) for k, frame in enumerate(numbered.frames)]
    caplog.clear()
    numbered.options["unordered"] = True
    export(replace(numbered, frames=frames, moving=None), tmp_path / "c", format="blender")
    assert "are counted from 0, which is shot.0010.jpg; a plate has the numbers of its files" in caplog.text


def test_every_lens_has_its_own_pinhole(shot: Reconstruction, tmp_path: Path) -> None:
    frames = [replace(f, camera=pycolmap.Camera(shot.camera.todict())) for f in shot.frames]
    for k, frame in enumerate(frames):
        frame.camera.params = [600.0 + 20 * k, 640.0 + 20 * k, *PARAMS[2:]]
    export(
        replace(shot, frames=frames, moving=None), tmp_path / "out", format="colmap",
        options=ExportOptions(undistorted=True),
    )  # fmt: skip
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert sorted(camera.params[0] for camera in model.cameras.values()) == pytest.approx([600, 620, 640, 680])
    for image in model.images.values():
        pixels = cv2.imread(str(tmp_path / "out" / "images" / image.name), NONE)
        assert pixels.shape[:2] == (image.camera.height, image.camera.width)


def test_footage_of_another_size_than_the_camera_is_refused(shot: Reconstruction, tmp_path: Path) -> None:
    images = noise_images(tmp_path / "shot", 21, name="shot.{:04d}.jpg")
    for path in images.iterdir():
        path.rename(path.with_name(f"shot.{int(path.stem[5:]) - 1001:04d}.jpg"))
    cv2.imwrite(str(images / "shot.0012.jpg"), np.zeros((48, 64, 3), np.uint8))
    options = ExportOptions(footage=images, undistorted=True)
    with pytest.raises(InputError, match=r"shot\.0012\.jpg of the footage has 64x48 pixels, the camera 640x480"):
        export(shot, tmp_path / "out", format="colmap", options=options)
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


@pytest.mark.parametrize(
    ("format", "options", "message"),
    [
        ("usd", {"undistorted": True}, "for colmap, colmap-binary, nerfstudio, not for usd"),
        ("ply", {"masks": "people"}, "for colmap, colmap-binary, nerfstudio, not for ply"),
        ("colmap", {"masks": "people"}, "colmap has only undistorted"),
        ("nerfstudio", {"masks": "nowhere"}, "no masks nowhere"),
    ],
)
def test_options_that_say_nothing_are_refused(
    shot: Reconstruction, tmp_path: Path, format: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        export(shot, tmp_path / "out", format=format, options=ExportOptions(**options))
    assert not list(tmp_path.iterdir())


def test_no_footage_to_undistort(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no footage to undistort"):
        export(build(), tmp_path / "out", format="colmap", options=ExportOptions(undistorted=True))


def test_it_says_what_to_type(shot: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutter = RollingShutter(0.5, 0.01, "rows", recorded=True)
    replace(shot, shutter=shutter, options={**shot.options, "masks": "hands"}).write(tmp_path / "result")
    command = ["export", str(tmp_path / "result"), "--format", "colmap", "--output", str(tmp_path / "my splats")]
    assert main([*command, "--undistorted"]) == 0
    said = capsys.readouterr().out
    for part in (
        f"simple_trainer.py default --data_dir '{tmp_path}/my splats' --data_factor 1 (it reads no masks)",
        f"ns-train splatfacto --data '{tmp_path}/my splats' colmap --colmap-path sparse/0 --masks-path masks",
        f"brush '{tmp_path}/my splats'",
        "No trainer knows the rolling shutter",
        "made with masks (hands), which --masks hands on",
    ):
        assert part in said
    assert main([*command[:-1], str(tmp_path / "model")]) == 0
    assert "add --undistorted" in capsys.readouterr().out
