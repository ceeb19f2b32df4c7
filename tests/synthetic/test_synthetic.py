import json
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.camera.files import read_camera
from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError
from factorsfm.synthetic import render_shot, simulate_prior, synthetic_scene, write_shot

MOTIONS = ["dolly", "truck", "handheld", "rotation", "static", "arc"]


def centers(poses):
    return np.array([pose.inverse().translation for pose in poses])


@pytest.fixture(scope="module")
def shot():
    return render_shot("truck", frames=4, width=240, height=136, parallax=0.05, seed=1)


@pytest.mark.parametrize("motion", MOTIONS)
def test_parallax_is_exact_and_the_path_starts_at_the_identity(motion):
    scene = synthetic_scene(motion, frames=20, parallax=0.04, seed=3)
    assert len(scene.cam_from_world) == 20
    np.testing.assert_allclose(scene.cam_from_world[0].matrix(), np.eye(3, 4), atol=1e-12)
    moved = np.linalg.norm(centers(scene.cam_from_world), axis=1).max()
    expected = 0.0 if motion in ("rotation", "static") else 0.04
    assert moved / np.median(scene.points[:, 2]) == pytest.approx(expected, abs=1e-12)


def test_arc_keeps_its_pivot_in_the_middle():
    scene = synthetic_scene("arc", parallax=0.3)
    pivot = np.array([[0, 0, np.median(scene.points[:, 2])]])
    for pose in scene.cam_from_world:
        np.testing.assert_allclose(pose * pivot, pivot, atol=1e-12)


def test_rotation_turns_and_handheld_depends_on_the_seed():
    angle = np.degrees(synthetic_scene("rotation").cam_from_world[-1].rotation.angle())
    assert angle == pytest.approx(12, abs=1e-9)
    first, again, other = (centers(synthetic_scene("handheld", seed=s).cam_from_world) for s in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


@pytest.mark.parametrize("motion", MOTIONS)
def test_observations_are_the_projections(motion):
    scene = synthetic_scene(motion, frames=5, parallax=0.1)
    for pose, (ids, xy) in zip(scene.cam_from_world, scene.observe(), strict=True):
        assert 200 < len(ids) < 400
        assert (xy >= -0.5).all()
        assert (xy < [639.5, 359.5]).all()
        cam_points = pose * scene.points[ids]
        uv = normalized_from_pixels(scene.camera, xy)
        np.testing.assert_allclose(uv, cam_points[:, :2] / cam_points[:, 2:], atol=1e-12)


def test_points_behind_the_camera_are_not_seen():
    scene = synthetic_scene("static", frames=2, points=50)
    behind = replace(scene, points=scene.points * [1, 1, -1])
    assert [len(ids) for ids, _ in behind.observe()] == [0, 0]


def test_observation_noise_has_the_size_asked_for():
    scene = synthetic_scene("dolly", points=800)
    exact, noisy, again, other = (scene.observe(noise, seed) for noise, seed in ((0, 0), (0.5, 1), (0.5, 1), (0.5, 2)))
    error = np.concatenate([n[1] - e[1] for n, e in zip(noisy, exact, strict=True)])
    assert error.std() == pytest.approx(0.5, rel=0.03)
    assert error.mean() == pytest.approx(0, abs=0.02)
    np.testing.assert_array_equal(noisy[3][1], again[3][1])
    assert np.abs(noisy[3][1] - other[3][1]).max() > 0.1
    assert [len(ids) for ids, _ in noisy] == [len(ids) for ids, _ in exact]


def test_inverse_depth_is_affine_with_the_noise_asked_for():
    scene = synthetic_scene("dolly", points=4000)
    ids = np.arange(0, 4000, 2)
    truth = 1 / (scene.cam_from_world[7] * scene.points[ids])[:, 2]
    np.testing.assert_allclose(1 / scene.depth(7, ids), truth, rtol=1e-12)
    np.testing.assert_allclose(scene.inverse_depth(7, ids, scale=3, shift=-0.2), 3 * truth - 0.2, rtol=1e-12)
    error = scene.inverse_depth(7, ids, scale=3, shift=-0.2, noise=0.05, seed=4) - (3 * truth - 0.2)
    assert error.std() == pytest.approx(0.05 * 3 * np.median(truth), rel=0.08)
    assert len(scene.inverse_depth(7, np.array([], dtype=int), noise=0.1)) == 0


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"motion": "zoom"}, '"zoom" is unknown'),
        ({"frames": 1}, "1 frames"),
        ({"parallax": -0.1}, "parallax -0.1"),
    ],
)
def test_impossible_shots_are_refused(arguments, reason):
    for make in (synthetic_scene, render_shot):
        with pytest.raises(InputError, match=reason):
            make(**arguments)


def test_depth_is_that_of_the_walls(shot):
    """The back wall is the plane z = 7, the floor y = 1.1, the side walls x = -2.3 and 2.3."""
    height, width = shot.depths[0].shape
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    for pose, depth in zip(shot.cam_from_world, shot.depths, strict=True):
        assert np.isfinite(depth).all()
        rays = np.column_stack([normalized_from_pixels(shot.camera, xy), np.ones(len(xy))])
        world = pose.inverse() * (rays * depth.reshape(-1, 1))
        planes = ((2, 7.0), (1, 1.1), (0, -2.3), (0, 2.3))
        on_wall = np.array([np.abs(world[:, axis] - value) < 1e-5 for axis, value in planes])
        assert (on_wall.mean(axis=1) > 0.01).all()
        assert (world[:, 2] < 7 + 1e-5).all()
        assert (np.abs(world[:, 0]) < 2.3 + 1e-5).all()
        assert on_wall.any(axis=0).mean() < 0.9  # boxes hide the rest


def test_rendered_parallax_is_exact(shot):
    moved = np.linalg.norm(centers(shot.cam_from_world), axis=1).max()
    assert moved / np.median(shot.depths[0]) == pytest.approx(0.05, rel=1e-6)


@pytest.mark.parametrize("motion", ["truck", "dolly", "arc", "handheld"])
def test_images_depths_and_poses_agree(motion):
    """The last image, brought back by depth and pose, lies on the first one to hundredths of a pixel."""
    shot = render_shot(motion, frames=2, width=320, height=180, parallax=0.04, seed=2)
    height, width = shot.depths[0].shape
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    rays = np.column_stack([normalized_from_pixels(shot.camera, xy), np.ones(len(xy))])
    moved = shot.cam_from_world[-1] * (rays * shot.depths[0].reshape(-1, 1))
    target = pixels_from_normalized(shot.camera, moved[:, :2] / moved[:, 2:]).astype(np.float32)
    maps = target.reshape(height, width, 2)

    depth = cv2.remap(shot.depths[-1], maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    visible = np.abs(depth / moved[:, 2].reshape(height, width) - 1) < 0.002
    assert visible.mean() > 0.75
    assert np.median(np.abs(depth / moved[:, 2].reshape(height, width) - 1)[visible]) < 2e-6

    visible = cv2.erode(visible.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    first, last = (cv2.cvtColor(shot.images[i], cv2.COLOR_BGR2GRAY).astype(np.float32) for i in (0, -1))
    difference = (cv2.remap(last, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC) - first)[visible]
    assert np.median(np.abs(difference)) < 2.5
    gradient = np.column_stack([cv2.Sobel(first, -1, *axis)[visible] / 8 for axis in ((1, 0), (0, 1))])
    offset = np.linalg.lstsq(gradient, difference, rcond=None)[0]
    assert np.abs(offset).max() < 0.05


def test_optical_flow_follows_the_truth(shot):
    first, last = (cv2.cvtColor(shot.images[i], cv2.COLOR_BGR2GRAY) for i in (0, 1))
    corners = cv2.goodFeaturesToTrack(first, 500, 0.01, 4)
    assert len(corners) > 300
    window = {"winSize": (11, 11), "maxLevel": 3}
    tracked, _, _ = cv2.calcOpticalFlowPyrLK(first, last, corners, None, **window)
    back, _, _ = cv2.calcOpticalFlowPyrLK(last, first, tracked, None, **window)
    good = np.linalg.norm((back - corners)[:, 0], axis=1) < 0.2
    assert good.mean() > 0.7
    xy = corners[good, 0].astype(np.float64)
    depth = shot.depths[0][xy[:, 1].astype(int), xy[:, 0].astype(int)]
    points = np.column_stack([normalized_from_pixels(shot.camera, xy), np.ones(len(xy))]) * depth[:, None]
    moved = shot.cam_from_world[1] * points
    error = tracked[good, 0] - pixels_from_normalized(shot.camera, moved[:, :2] / moved[:, 2:])
    assert np.median(np.linalg.norm(error, axis=1)) < 0.15
    assert np.abs(np.median(error, axis=0)).max() < 0.005


@pytest.mark.parametrize("seed", range(4))
def test_texture_is_everywhere(seed):
    shot = render_shot("static", frames=2, width=240, height=136, seed=seed)
    grey = cv2.cvtColor(shot.images[0], cv2.COLOR_BGR2GRAY)
    blocks = grey[:136, :240].reshape(17, 8, 30, 8).transpose(0, 2, 1, 3).reshape(-1, 64).astype(float)
    assert np.quantile(blocks.std(axis=1), 0.02) > 2.5
    assert grey.std() > 20
    assert ((grey < 3) | (grey > 252)).mean() < 0.01
    np.testing.assert_array_equal(shot.images[0], shot.images[1])


def test_prior_is_affine_in_inverse_depth_up_to_a_smooth_error(shot):
    priors = simulate_prior(shot, seed=5)
    exact = simulate_prior(shot, error=0.0, seed=5)
    fits = []
    for prior, faultless, depth in zip(priors, exact, shot.depths, strict=True):
        assert prior.dtype == np.float32
        inverse = 1 / depth.astype(np.float64).ravel()
        design = np.column_stack([inverse, np.ones(inverse.size)])
        fit, *_ = np.linalg.lstsq(design, faultless.ravel().astype(np.float64), rcond=None)
        np.testing.assert_allclose(design @ fit, faultless.ravel(), rtol=1e-6)
        fits.append(fit)
        fit, *_ = np.linalg.lstsq(design, prior.ravel().astype(np.float64), rcond=None)
        relative = (prior.ravel() - design @ fit) / (fit[0] * inverse)
        assert 0.02 < relative.std() < 0.08
    assert (np.ptp(np.array(fits), axis=0) > [0.1, 0.003]).all()  # every frame has its own scale and shift


def test_written_shot_reads_back(shot, tmp_path):
    write_shot(shot, tmp_path / "shot")
    folder = tmp_path / "shot"
    frames = list(read_frames(folder / "shot.mp4"))
    assert len(frames) == len(shot.images)
    for frame, image in zip(frames, shot.images, strict=True):
        assert frame.timestamp == pytest.approx(frame.index / 24, abs=1e-6)
        assert cv2.PSNR(frame.image, image) > 29
    assert read_camera(folder / "camera.json") == shot.camera
    assert json.loads((folder / "camera.json").read_text())["cx"] == 119.5
    for index, prior in enumerate(simulate_prior(shot)):
        np.testing.assert_array_equal(np.load(folder / "depth" / f"{index:06d}.npy"), prior)
    for line, pose in zip(np.loadtxt(folder / "groundtruth.txt"), shot.cam_from_world, strict=True):
        world_from_cam = pycolmap.Rigid3d(pycolmap.Rotation3d(line[4:]), line[1:4])
        np.testing.assert_allclose((world_from_cam * pose).matrix(), np.eye(3, 4), atol=1e-8)


def test_unwritable_folder_is_refused(shot, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        write_shot(shot, tmp_path / "file")
