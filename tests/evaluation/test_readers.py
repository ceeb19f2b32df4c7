"""Every data-set format, from a tiny file set made on the spot."""

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from factorsfm.evaluation.metrics import point_depth_errors
from factorsfm.evaluation.plain_pickle import load_plain_pickle
from factorsfm.evaluation.readers import (
    read_7scenes,
    read_colmap,
    read_eth3d,
    read_shot,
    read_studiosfm,
    read_tum,
)
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError

WIDTH, HEIGHT = 12, 8
K = np.array([[10.0, 0, 6], [0, 11, 4], [0, 0, 1]])
QUATERNION = np.array([0.5, -0.5, 0.5, 0.5])  # xyzw: a third of a turn
ROTATION = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
CENTER = np.array([1.0, -2.0, 0.5])


def camera():
    return pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=[10.0, 11.0, 6.0, 4.0])


def write_image(path: Path, level: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), level, np.uint8))


def write_depth(path: Path, invalid: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    steps = np.full((HEIGHT, WIDTH), 3000, np.uint16)
    steps[0, 0], steps[0, 1] = 0, invalid
    assert cv2.imwrite(str(path), steps)


def cam_from_world(center=CENTER) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ROTATION.T, -ROTATION.T @ center
    return matrix


def check_pose(shot, row=0, center=CENTER):
    assert_allclose(shot.rotations[row], ROTATION, atol=1e-9)
    assert_allclose(shot.centers[row], center, atol=1e-9)


def check_depth(shot, index, metres, holes):
    depth = shot.depth(index)
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth.dtype == np.float32
    assert_allclose(depth[4, 4], metres, rtol=1e-6)
    assert np.isnan(depth).sum() == holes


def levels(shot):
    return [int(np.rint(frame.image.mean())) for frame in shot.frames()]


@pytest.fixture
def own_set(tmp_path):
    folder = tmp_path / "kitchen"
    for i in range(3):
        write_image(folder / "images" / f"{i:05d}.png", 10 * i)
    write_depth(folder / "depth" / "00001.png")
    facts = {
        "width": WIDTH,
        "height": HEIGHT,
        "fx": 10,
        "fy": 11,
        "cx": 5.5,
        "cy": 3.5,
        "depth_unit_m": 0.002,
    }
    (folder / "camera.json").write_text(json.dumps(facts))
    lines = [" ".join(map(str, [i, *(100 * CENTER + i), *QUATERNION])) for i in (2, 0)]
    (folder / "groundtruth.txt").write_text("# frame ...\n" + "\n".join(lines) + "\n")
    return folder


def test_read_shot(own_set):
    shot = read_shot(own_set, unit=0.01)
    assert shot.name == "kitchen"
    assert shot.indices.tolist() == [0, 2]
    check_pose(shot)
    check_pose(shot, row=1, center=CENTER + 0.02)
    assert_allclose(shot.camera.params, [10, 11, 6, 4])
    assert levels(shot) == [0, 10, 20]
    assert [frame.name for frame in shot.frames()] == ["00000.png", "00001.png", "00002.png"]
    check_depth(shot, 1, metres=6.0, holes=2)
    assert shot.depth(0) is None
    assert shot.masks is None


def test_truth_of_chosen_frames(own_set):
    shot = read_shot(own_set)
    rotations, centers = shot.truth(np.array([2, 0]))
    assert_allclose(rotations, [ROTATION, ROTATION], atol=1e-9)
    assert_allclose(centers, [100 * CENTER + 2, 100 * CENTER])
    with pytest.raises(InputError, match="frame 1 of kitchen has no true pose"):
        shot.truth(np.array([0, 1]))


def test_read_shot_with_video_and_masks(own_set):
    facts = json.loads((own_set / "camera.json").read_text())
    facts["depth_unit_mm"] = 0.5
    del facts["depth_unit_m"]
    facts["width"], facts["height"] = 64, 48
    (own_set / "camera.json").write_text(json.dumps(facts))
    (own_set / "masks").mkdir()
    video = cv2.VideoWriter(str(own_set / "shot.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 24, (64, 48))
    assert video.isOpened()
    for i in range(3):
        video.write(np.full((48, 64, 3), 80 * i, np.uint8))
    video.release()
    shot = read_shot(own_set)
    assert shot.source.name == "shot.mp4"
    assert shot.files is None
    assert shot.masks == own_set / "masks"
    assert_allclose(levels(shot), [0, 80, 160], atol=6)
    check_depth(shot, 1, metres=1.5, holes=2)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("groundtruth.txt", "0 1 2 3\n", "expected rows of 8 numbers"),
        ("groundtruth.txt", "0 a 2 3 0 0 0 1\n", "not a table of numbers"),
        ("groundtruth.txt", "0 1 2 3 0 0 0 2\n", "quaternions not of length 1"),
        ("groundtruth.txt", None, "cannot be read as text"),
        ("camera.json", None, "camera file"),
    ],
)
def test_read_shot_refuses_bad_files(own_set, name, content, message):
    (own_set / name).unlink()
    if content is not None:
        (own_set / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_shot(own_set)


def test_every_development_shot_can_be_read(shared_data):
    folders = sorted(shared_data.glob("studiosim/*/")) + sorted(shared_data.glob("real/*/"))
    assert len(folders) == 20
    for folder in folders:
        shot = read_shot(folder)
        image = next(shot.frames()).image
        assert image.shape == (shot.camera.height, shot.camera.width, 3)
        assert (shot.masks is not None) == (folder / "masks").is_dir()
        with_depth = [i for i in (0, 4, 8) if shot.depth(i) is not None]
        assert bool(with_depth) == (folder / "depth").is_dir()
        if with_depth:
            assert transferred_depth_error(shot, with_depth[0], with_depth[-1]) < 0.01, folder


def transferred_depth_error(shot, first, second):
    """Median relative error of one frame's true depth, carried into another frame by the true poses."""
    depth = shot.depth(first)
    size = np.array([shot.camera.width, shot.camera.height])
    step = size / depth.shape[::-1]
    y, x = np.nonzero(np.isfinite(depth))
    z = depth[y, x][:, None]
    uv = shot.camera.cam_from_img((np.stack([x, y], axis=1) + 0.5) * step)
    (r1, r2), (c1, c2) = shot.truth(np.array([first, second]))
    world = np.hstack([uv * z, z]) @ r1.T + c1
    seen = (world - c2) @ r2
    ahead = seen[:, 2] > 0.1
    xy = np.full((len(seen), 2), np.nan)
    xy[ahead] = shot.camera.img_from_cam(seen[ahead]) - 0.5
    errors = point_depth_errors(xy, seen[:, 2], shot.depth(second), size).relative
    assert np.isfinite(errors).sum() > 1000
    return np.nanmedian(errors)


def write_studiosfm(folder: Path, records: object, protocol: int | None = None) -> Path:
    for i in (10, 9, 11):
        write_image(folder / "images" / f"img_{i}.png", i)
    (folder / "camera.pkl").write_bytes(pickle.dumps(records, protocol))
    return folder


def record(center=CENTER):
    return {"intr_mtx": K, "v2c": cam_from_world(center)}


@pytest.mark.parametrize("ids", [(9, 11), ("img_9", "img_11"), ("img_9.png", "img_11.png"), ("0009", "0011")])
def test_read_studiosfm(tmp_path, ids):
    shot = read_studiosfm(write_studiosfm(tmp_path, {ids[1]: record(CENTER + 1), ids[0]: record()}))
    assert shot.indices.tolist() == [0, 2]
    check_pose(shot)
    check_pose(shot, row=1, center=CENTER + 1)
    assert levels(shot) == [9, 10, 11]
    assert [frame.name for frame in read_frames(shot.source)] == [frame.name for frame in shot.frames()]
    assert (shot.camera.width, shot.camera.height) == (WIDTH, HEIGHT)
    assert_allclose(shot.camera.params, [10, 11, 6, 4])


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_studiosfm_pickles_of_any_age(tmp_path, protocol):
    """Also the module names of numpy 1, and matrices as lists, float32 and numpy scalars as ids."""
    records = {
        np.int64(9): {
            "intr_mtx": K.tolist(),
            "v2c": [[np.float64(v) for v in row] for row in cam_from_world()],
        },
        np.int64(10): {"intr_mtx": K.astype(np.float32), "v2c": np.asfortranarray(cam_from_world())},
    }
    folder = write_studiosfm(tmp_path, records, protocol)
    if protocol == 3:
        data = (folder / "camera.pkl").read_bytes()
        assert b"numpy._core" in data or b"numpy.core" in data
        (folder / "camera.pkl").write_bytes(data.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    check_pose(read_studiosfm(folder))


def test_an_array_as_python_2_pickled_it(tmp_path):
    (tmp_path / "a.pkl").write_bytes(
        b"cnumpy.core.multiarray\n_reconstruct\np0\n(cnumpy\nndarray\np1\n(I0\ntp2\nS'b'\np3\ntp4\nRp5\n(I1\n(I2\ntp6\n"
        b"cnumpy\ndtype\np7\n(S'f8'\np8\nI0\nI1\ntp9\nRp10\n(I3\nS'<'\np11\nNNNI-1\nI-1\nI0\ntp12\nbI00\n"
        rb"S'\x00\x00\x00\x00\x00\x00\xf0?\x00\x00\x00\x00\x00\x00\x00@'"
        b"\np13\ntp14\nb."
    )
    assert_allclose(load_plain_pickle(tmp_path / "a.pkl"), [1.0, 2.0])


def test_no_codec_but_that_of_bytes_is_looked_up(tmp_path):
    (tmp_path / "a.pkl").write_bytes(b"c_codecs\nencode\n(Vabc\nVrot13\ntR.")
    with pytest.raises(InputError, match="encoded as 'rot13'"):
        load_plain_pickle(tmp_path / "a.pkl")


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_containers_of_any_age(tmp_path, protocol):
    content = {"a": {1, 2}, "b": frozenset([3]), "c": (b"\x00\xff", [np.float64(2.0)])}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content, protocol))
    assert load_plain_pickle(tmp_path / "a.pkl") == content


class Evil:
    """Creates a file when unpickled by an ordinary reader."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


class EvilBuiltin(Evil):
    def __reduce__(self):
        return eval, (f"open({str(self.path)!r}, 'w')",)


@pytest.mark.parametrize("evil", [Evil, EvilBuiltin])
@pytest.mark.parametrize("place", ["top", "value", "object array"])
def test_malicious_pickle_is_refused_unexecuted(tmp_path, evil, place):
    victim = tmp_path / "executed"
    bomb = evil(victim)
    bombs = np.empty(1, object)
    bombs[0] = bomb
    content = {"top": bomb, "value": {9: bomb}, "object array": {9: {"intr_mtx": bombs, "v2c": bombs}}}[place]
    folder = write_studiosfm(tmp_path / "shot", content)
    with pytest.raises(InputError, match="not a pickle of plain data"):
        read_studiosfm(folder)
    assert not victim.exists()
    pickle.loads((folder / "camera.pkl").read_bytes())
    assert victim.exists()  # the attack is real


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ({}, "no dictionary of cameras"),
        ([1, 2], "no dictionary of cameras"),
        ({9: {"intr_mtx": K}}, "camera 9 .* has no 3x3"),
        ({9: {"intr_mtx": K, "v2c": np.eye(3)}}, "camera 9 .* has no 3x3"),
        ({9: {"intr_mtx": K, "v2c": 2 * np.eye(4)}}, "not rotations"),
        ({77: record()}, "image id 77 matches none of the 3 images"),
        ({"last": record()}, "image id 'last' holds no number"),
    ],
)
def test_read_studiosfm_refuses_bad_cameras(tmp_path, records, message):
    with pytest.raises(InputError, match=message):
        read_studiosfm(write_studiosfm(tmp_path, records))


def test_damaged_pickle_is_refused(tmp_path):
    folder = write_studiosfm(tmp_path, {9: record()})
    (folder / "camera.pkl").write_bytes((folder / "camera.pkl").read_bytes()[:-20])
    with pytest.raises(InputError, match="not a pickle of plain data"):
        read_studiosfm(folder)


def colmap_model(names):
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera())
    for i, name in enumerate(names):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world(CENTER + i)[:3]))
    return reconstruction


@pytest.mark.parametrize("text", [True, False])
def test_read_colmap(tmp_path, text):
    model, images = tmp_path / "model", tmp_path / "images"
    model.mkdir()
    reconstruction = colmap_model(["sub/img10.png", "sub/img9.png"])
    (reconstruction.write_text if text else reconstruction.write_binary)(model)
    for i in (8, 9, 10):
        write_image(images / "sub" / f"img{i}.png", i)
    shot = read_colmap(model, images, "name")
    assert shot.indices.tolist() == [1, 2]
    check_pose(shot, row=0, center=CENTER + 1)
    check_pose(shot, row=1, center=CENTER)
    assert levels(shot) == [8, 9, 10]
    assert shot.depth(1) is None
    assert_allclose(shot.camera.params, [10, 11, 6, 4])


def test_read_colmap_refuses_bad_models(tmp_path):
    with pytest.raises(InputError, match=r"the COLMAP model in .* cannot be read"):
        read_colmap(tmp_path, tmp_path)
    colmap_model([]).write_text(tmp_path)
    with pytest.raises(InputError, match="no registered image"):
        read_colmap(tmp_path, tmp_path)
    colmap_model(["a/1.png", "b/2.png"]).write_text(tmp_path)
    with pytest.raises(InputError, match="are in 2 folders"):
        read_colmap(tmp_path, tmp_path)
    colmap_model(["1.png", "2.png"]).write_text(tmp_path)
    write_image(tmp_path / "1.png", 0)
    with pytest.raises(InputError, match=r"image 2\.png of .* is missing"):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize("fits", [True, False])
def test_read_eth3d(tmp_path, fits):
    """With a model as ETH3D distributes it: the old text format, without rigs and frames."""
    model = tmp_path / "dslr_calibration_undistorted"
    model.mkdir()
    (model / "cameras.txt").write_text(f"# cameras\n5 PINHOLE {WIDTH} {HEIGHT} 10 11 6 4\n")
    pose = pycolmap.Rigid3d(cam_from_world()[:3])
    x, y, z, w = pose.rotation.quat
    numbers = " ".join(map(str, [w, x, y, z, *pose.translation]))
    (model / "images.txt").write_text(f"# images\n3 {numbers} 5 dslr_images_undistorted/DSC_2.png\n\n")
    (model / "points3D.txt").write_text("# points\n")
    write_image(tmp_path / "images" / "dslr_images_undistorted" / "DSC_2.png", 7)
    depth = np.full((HEIGHT, WIDTH), 4.0, "<f4")
    depth[0, :2] = np.inf, 0
    maps = tmp_path / "ground_truth_depth" / "dslr_images"
    maps.mkdir(parents=True)
    (maps / "DSC_2.png").write_bytes(depth.tobytes() if fits else depth[1:].tobytes())
    shot = read_eth3d(tmp_path)
    assert shot.indices.tolist() == [0]
    check_pose(shot)
    assert levels(shot) == [7]
    if fits:
        check_depth(shot, 0, metres=4.0, holes=2)
    else:
        assert shot.depth(0) is None


def test_read_eth3d_needs_a_calibration(tmp_path):
    with pytest.raises(InputError, match="neither dslr_calibration_undistorted nor dslr_calibration_jpg"):
        read_eth3d(tmp_path)


def test_read_tum(tmp_path):
    stamps = ["100.00", "100.03", "100.06", "100.50"]
    for i, stamp in enumerate(stamps):
        write_image(tmp_path / "rgb" / f"{stamp}.png", 10 * i)
    write_depth(tmp_path / "depth" / "100.04.png")
    lines = "\n".join(f"{stamp} rgb/{stamp}.png" for stamp in stamps)
    (tmp_path / "rgb.txt").write_text(f"# color images\n{lines}\n")
    (tmp_path / "depth.txt").write_text("100.04 depth/100.04.png\n")
    poses = [
        " ".join(map(str, [t, *(CENTER + i), *QUATERNION])) for i, t in enumerate((99.99, 100.005, 100.065, 100.4))
    ]
    (tmp_path / "groundtruth.txt").write_text("# ground truth\n" + "\n".join(poses) + "\n")
    shot = read_tum(tmp_path, camera())
    assert shot.indices.tolist() == [0, 2]  # the others are more than 20 ms from any pose
    check_pose(shot, row=0, center=CENTER + 1)
    check_pose(shot, row=1, center=CENTER + 2)
    assert levels(shot) == [0, 10, 20, 30]
    assert [shot.depth(i) is None for i in range(4)] == [True, False, False, True]
    check_depth(shot, 1, metres=0.6, holes=2)


def test_read_7scenes(tmp_path):
    for i in range(3):
        write_image(tmp_path / f"frame-{i:06d}.color.png", i)
        write_depth(tmp_path / f"frame-{i:06d}.depth.png", invalid=65535)
        matrix = np.linalg.inv(cam_from_world(CENTER + i))
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", matrix if i != 1 else np.full((4, 4), np.nan))
    shot = read_7scenes(tmp_path)
    assert shot.indices.tolist() == [0, 2]
    check_pose(shot)
    check_pose(shot, row=1, center=CENTER + 2)
    assert levels(shot) == [0, 1, 2]  # not the depth maps that lie between
    check_depth(shot, 1, metres=3.0, holes=2)
    assert (shot.camera.width, shot.camera.height) == (640, 480)
    assert read_7scenes(tmp_path, camera()).camera.width == WIDTH


def test_read_7scenes_refuses_an_empty_folder(tmp_path):
    with pytest.raises(InputError, match="holds no images"):
        read_7scenes(tmp_path)


def test_damaged_images_are_reported(own_set):
    (own_set / "images" / "00001.png").write_bytes(b"no image")
    (own_set / "depth" / "00001.png").write_bytes(b"no image")
    shot = read_shot(own_set)
    with pytest.raises(InputError, match=r"00001\.png cannot be decoded"):
        list(shot.frames())
    with pytest.raises(InputError, match="not a depth map"):
        shot.depth(1)
