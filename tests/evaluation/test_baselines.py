"""COLMAP baselines on a few small frames, degraded footage, and priors that know nothing."""

import copy
import itertools
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from factorsfm.evaluation import baselines
from factorsfm.evaluation.baselines import (
    colmap_default,
    colmap_global,
    colmap_tuned,
    match_frames,
    run_baselines,
)
from factorsfm.evaluation.degrade import degrade, degraded_frames
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.useless_priors import (
    ImageRowPrior,
    RandomSmoothPrior,
    image_row_depth,
    random_smooth_depth,
)
from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.depth_map import DepthKind
from factorsfm.support.errors import InputError

SIZE = (320, 240)


@pytest.fixture
def clip(shared_data):
    """A shot at half size and six of its frames."""
    shot = read_shot(shared_data / "real" / "kitchen-528")
    camera = copy.copy(shot.camera)
    camera.rescale(*SIZE)
    frames = [
        replace(frame, image=cv2.resize(frame.image, SIZE, interpolation=cv2.INTER_AREA))
        for frame in itertools.islice(shot.frames(), 0, 24, 4)
    ]
    return replace(shot, camera=camera), frames


def test_baselines_on_a_small_clip(clip):
    shot, frames = clip
    results = run_baselines(shot, frames, (colmap_default, colmap_tuned, colmap_global), max_features=600)
    assert list(results) == ["colmap_default", "colmap_tuned", "colmap_global"]
    # Parallax of 0.06 is too little for the thresholds that COLMAP ships with.
    assert np.isnan(results["colmap_default"].centers).all()
    assert len(results["colmap_default"].points) == 0
    for name in ("colmap_tuned", "colmap_global"):
        result = results[name]
        assert result.indices.tolist() == [0, 4, 8, 12, 16, 20]
        errors = trajectory_errors(result.rotations, result.centers, *shot.truth(result.indices))
        assert 1e-5 < np.median(errors.ate) < 0.003
        assert np.median(errors.r_rpe) < 0.3
        assert set(result.seconds) == {"extraction", "matching", "mapping"}
        assert min(result.seconds.values()) > 0
        check_observations(shot, result)


def check_observations(shot, result):
    """The true lens, poses, points and pixels of the result agree with each other."""
    frame, point = result.observation_frame, result.observation_point
    assert len(frame) > 2 * len(result.points) > 200
    local = np.einsum("nji,nj->ni", result.rotations[frame], result.points[point] - result.centers[frame])
    assert_allclose(local[:, 2], result.observation_depth, rtol=1e-9)
    distance = np.linalg.norm(shot.camera.img_from_cam(local) - 0.5 - result.observation_xy, axis=1)
    assert np.median(distance) < 0.5
    assert distance.max() < 4.5


def test_sequential_matching_with_masks(clip, tmp_path, monkeypatch):
    shot, frames = clip
    for frame in frames:
        ignored = np.zeros((120, 160), np.uint8)
        ignored[:, :60] = 255
        cv2.imwrite(str(tmp_path / f"{frame.index:06d}.png"), ignored)
    monkeypatch.setattr(baselines, "EXHAUSTIVE_UP_TO", 3)
    result = run_baselines(replace(shot, masks=tmp_path), frames, (colmap_tuned,), 400)["colmap_tuned"]
    assert np.isfinite(result.centers).all()
    assert result.observation_xy[:, 0].min() > 119
    assert result.observation_xy[:, 0].max() > 280


class FakeModel:
    """A model of which only the size is known."""

    def __init__(self, registered, points):
        self.registered, self.points = registered, points
        self.images, self.points3D = {}, {}

    def num_reg_images(self):
        return self.registered

    def num_points3D(self):
        return self.points


@pytest.mark.parametrize(
    ("models", "tried", "kept"),
    [
        ([FakeModel(19, 5)], 1, 0.5),
        ([FakeModel(18, 5), None, FakeModel(18, 6), FakeModel(17, 9)], 4, 0.2),
        ([None, FakeModel(20, 5)], 2, 2.0),
    ],
)
def test_tuned_keeps_the_best_setting(monkeypatch, tmp_path, models, tried, kept):
    asked = []

    def mapping(matches, options):
        asked.append((options.mapper.init_min_tri_angle, options.mapper.filter_min_tri_angle))
        return models[len(asked) - 1]

    monkeypatch.setattr(baselines, "_incremental", mapping)
    result = colmap_tuned(baselines.Matches(tmp_path, np.arange(20), {}))
    assert asked == [(0.5, 0.05), (2.0, 0.1), (0.2, 0.02), (4.0, 0.2)][:tried]
    assert result.settings.startswith(f"first pair from {kept} degrees")


def test_options_differ_from_colmap_as_documented():
    def changed(options, reference):
        return {
            key: value
            for key, value in options.todict().items()
            if not isinstance(value, dict) and value != getattr(reference, key)
        }

    plain, tuned = pycolmap.IncrementalPipelineOptions(), baselines.tuned_options(0.5, 0.05)
    fixed = {"ba_refine_focal_length": False, "ba_refine_extra_params": False}
    lens = {"abs_pose_refine_focal_length": False, "abs_pose_refine_extra_params": False}
    assert changed(baselines.default_options(), plain) == fixed
    assert changed(baselines.default_options().mapper, plain.mapper) == lens
    assert changed(tuned, plain) == fixed | {"min_model_size": 3}
    assert changed(tuned.triangulation, plain.triangulation) == {"min_angle": 0.05}
    assert changed(tuned.mapper, plain.mapper) == lens | {
        "init_min_tri_angle": 0.5,
        "filter_min_tri_angle": 0.05,
        "ba_local_min_tri_angle": 0.1,
        "init_max_forward_motion": 1.0,
        "init_min_num_inliers": 50,
        "abs_pose_min_num_inliers": 15,
    }


def test_baselines_refuse_bad_frames(clip, tmp_path):
    shot, frames = clip
    with pytest.raises(InputError, match="two frames at least, 1 given"):
        run_baselines(shot, frames[:1])
    with pytest.raises(InputError, match="frame 0 is 160x240 pixels, its lens 320x240"):
        match_frames(shot, [replace(frames[0], image=frames[0].image[:, :160])], tmp_path)


@pytest.fixture
def image():
    ramp = np.linspace(60, 190, 200)
    return np.repeat(np.tile(ramp, (150, 1)).astype(np.uint8)[..., None], 3, axis=2)


def test_degrade_adds_noise_of_the_given_strength(image):
    noisy = degrade(image, np.random.default_rng(1), blur=0.0, noise=8.0, jpeg_quality=100)
    difference = noisy.astype(float) - image
    assert difference.mean() == pytest.approx(0.0, abs=0.2)
    # JPEG keeps grey noise, and halves the resolution of the colour noise.
    assert difference.mean(axis=2).std() == pytest.approx(8 / np.sqrt(3), rel=0.15)


def test_degrade_blurs(image):
    step = np.zeros((60, 80), np.uint8)
    step[:, 40:] = 200
    soft = degrade(step, np.random.default_rng(1), blur=2.0, noise=0.0, jpeg_quality=100)
    # Slope of a blurred step: height / (sigma sqrt(2 pi)).
    assert soft.shape == step.shape
    assert np.diff(soft[30].astype(float)).max() == pytest.approx(200 / (2 * np.sqrt(2 * np.pi)), rel=0.01)


def test_degrade_compresses(image):
    rng = np.random.default_rng(2)
    busy = rng.integers(0, 255, (64, 64, 3), np.uint8)
    loss = [np.abs(degrade(busy, rng, 0.0, 0.0, quality).astype(float) - busy).mean() for quality in (10, 40, 95)]
    assert loss[0] > loss[1] > loss[2] > 0


@pytest.mark.parametrize("options", [{"blur": -1}, {"noise": -1}, {"jpeg_quality": 0}])
def test_degrade_refuses_bad_options(image, options):
    with pytest.raises(InputError, match="must not be negative"):
        degrade(image, np.random.default_rng(0), **options)


def test_degraded_frames_are_the_same_in_every_run_and_range(image):
    frames = [Frame(i, image, f"{i:06d}", i / 24) for i in range(3)]
    all_of_them = list(degraded_frames(frames, seed=5))
    alone = next(degraded_frames(frames[2:], seed=5))
    assert [(f.index, f.name, f.timestamp) for f in all_of_them] == [(f.index, f.name, f.timestamp) for f in frames]
    assert_array_equal(all_of_them[2].image, alone.image)
    assert (all_of_them[0].image != all_of_them[1].image).any()
    assert (next(degraded_frames(frames, seed=6)).image != all_of_them[0].image).any()


def test_image_row_depth_is_nearer_at_the_bottom():
    field = image_row_depth((4, 3))
    assert field.dtype == np.float32
    assert_allclose(field, np.repeat([[0.25], [0.5], [0.75], [1.0]], 3, axis=1))


def test_random_smooth_depth_is_smooth_and_positive():
    fields = [random_smooth_depth((96, 160), np.random.default_rng(i)) for i in range(40)]
    logs = np.log(fields)
    assert fields[0].dtype == np.float32
    assert logs.std() == pytest.approx(0.5, rel=0.07)
    # Correlation 1/e at twice the blur, which is a quarter of the width.
    near, far = ((logs[:, :, :-lag] * logs[:, :, lag:]).mean() / (logs**2).mean() for lag in (40, 120))
    assert near == pytest.approx(np.exp(-1), abs=0.02)
    assert abs(far) < 0.12


@pytest.mark.parametrize("prior", [ImageRowPrior(), RandomSmoothPrior(seed=3)])
def test_useless_priors_are_depth_priors(prior, image):
    frames = [Frame(i, image, f"{i:06d}", None) for i in range(2)]
    assert isinstance(prior, DepthPrior)
    maps = [prior(frame) for frame in frames]
    assert maps[0].kind is prior.kind is DepthKind.INVERSE
    assert np.isfinite(maps[0].values).all()
    assert_array_equal(prior(frames[0]).values, maps[0].values)
    assert (maps[0].values != maps[1].values).any() == isinstance(prior, RandomSmoothPrior)
