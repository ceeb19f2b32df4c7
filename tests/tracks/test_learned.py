"""Learned features: the networks themselves where they are, and their way through the database with others in place."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm import ModelError, reconstruct
from factorsfm.cli import main as cli
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot
from factorsfm.tracks import matches
from factorsfm.tracks.learned import FEATURES, Keypoints, LearnedFeatures, common_features
from factorsfm.tracks.matches import match_images
from tests.image_files import write_images
from tests.networks import save_network


class Corners(LearnedFeatures):
    """OpenCV's SIFT in place of the networks."""

    def __init__(self) -> None:
        self.name = "xfeat"
        self.found = self.matched = 0

    def find(self, image: np.ndarray, mask: np.ndarray | None = None) -> Keypoints:
        self.found += 1
        allowed = None if mask is None else np.where(mask, 0, 255).astype(np.uint8)
        points, descriptors = cv2.SIFT_create(600).detectAndCompute(image, allowed)
        if not points:
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), image.shape[1::-1])
        descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
        return Keypoints(np.array([p.pt for p in points], np.float32), descriptors, image.shape[1::-1])

    def match(self, a: Keypoints, b: Keypoints) -> np.ndarray:
        self.matched += 1
        cosine = a.descriptors @ b.descriptors.T
        there, back = cosine.argmax(1), cosine.argmax(0)
        rows = np.nonzero((back[there] == np.arange(len(there))) & (cosine.max(1) > 0.9))[0]
        return np.stack([rows, there[rows]], 1)


@pytest.fixture(scope="module")
def shot() -> RenderedShot:
    return render_shot("truck", 4, 400, 300, parallax=0.15)


def transfer_errors(shot: RenderedShot, found: matches.SetMatches, pair: matches.PairMatches) -> np.ndarray:
    """(m, 2) pixels: keypoints of the first image, lifted with the true depth, in the second."""
    a, b = found.keypoints[pair.first][pair.rows[:, 0]], found.keypoints[pair.second][pair.rows[:, 1]]
    x, y = np.clip(np.rint(a).astype(int), 0, [[399, 299]]).T
    rays = np.column_stack([shot.camera.cam_from_img(a + 0.5), np.ones(len(a))])
    relative = shot.cam_from_world[pair.second] * shot.cam_from_world[pair.first].inverse()
    there = np.asarray(shot.camera.img_from_cam(relative * (rays * shot.depths[pair.first][y, x][:, None]))) - 0.5
    return there - b


def test_learned_matches_are_verified_and_kept(shot: RenderedShot, tmp_path: Path) -> None:
    names, features = write_images(shot, tmp_path / "images"), Corners()
    database, cameras = tmp_path / "m.db", [shot.camera] * 4
    first = match_images(database, tmp_path / "images", names[:3], cameras[:3], features=features)
    assert (features.found, features.matched) == (3, 3)
    second = match_images(database, tmp_path / "images", names, cameras, features=features)
    assert (features.found, features.matched) == (4, 6)  # only what is new
    assert np.array_equal(first.pairs[0].rows, second.pairs[0].rows)
    assert [(p.first, p.second) for p in second.pairs] == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    for pair in second.pairs:
        errors = transfer_errors(shot, second, pair)
        assert len(errors) > 80
        assert 0.05 < np.median(np.linalg.norm(errors, axis=1)) < 0.3
        assert np.abs(np.median(errors, axis=0)).max() < 0.03  # half a pixel would show
    with pycolmap.Database.open(database) as db:
        assert db.num_matches() > db.num_inlier_matches() > 0  # something was wrong, and is gone


def test_masked_and_blank_images(shot: RenderedShot, tmp_path: Path) -> None:
    names = write_images(shot, tmp_path / "images")[:3]
    cv2.imwrite(str(tmp_path / "images" / names[1]), np.full((300, 400), 90, np.uint8))
    (tmp_path / "masks").mkdir()
    for name in names:
        mask = np.full((300, 400), 255, np.uint8)
        mask[:, :200] = 0
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    found = match_images(
        tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 3, tmp_path / "masks", features=Corners()
    )
    assert [len(k) > 0 for k in found.keypoints] == [True, False, True]
    assert found.keypoints[0][:, 0].min() > 198
    assert [(p.first, p.second) for p in found.pairs] == [(0, 2)]


def test_large_sets_are_paired_by_their_strongest_keypoints(
    shot: RenderedShot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images and their mirror images: each has one like itself, far away in the order of names."""
    monkeypatch.setattr(matches, "EXHAUSTIVE_UP_TO", 2)
    monkeypatch.setattr(matches, "_NEIGHBOURS_BY_APPEARANCE", 1)
    monkeypatch.setattr(matches, "_NEIGHBOURS_BY_NAME", 0)
    (tmp_path / "images").mkdir()
    pictures = [shot.images[0], cv2.flip(shot.images[0], 1), cv2.flip(shot.images[2], 1), shot.images[2]]
    for k, image in enumerate(pictures):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), image)
    names, features = [f"{k}.png" for k in range(4)], Corners()
    found = match_images(tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 4, features=features)
    assert [(p.first, p.second) for p in found.pairs] == [(0, 3), (1, 2)]
    assert features.matched == 2


def test_common_features_are_mutual_nearest_neighbours() -> None:
    one = np.eye(8, dtype=np.float32)
    images = [Keypoints(np.zeros((len(d), 2), np.float32), d, (9, 9)) for d in (one, one[[1, 2, 3]], -one, one[:0])]
    assert common_features(images).tolist() == [[0, 3, 0, 0], [3, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]


def test_a_missing_network_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FACTORSFM_MODELS", str(tmp_path))
    monkeypatch.setattr("factorsfm.priors.models.cache_folder", lambda: tmp_path / "cache")
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((40, 60, 3), np.uint8))
    command = ["reconstruct", str(tmp_path / "images"), "--output", str(tmp_path / "out"), "--depth", "none"]
    assert cli.main([*command, "--unordered", "--features", "xfeat"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"the network xfeat.onnx is in none of {tmp_path}, " in said
    assert "set FACTORSFM_MODELS to a folder that holds xfeat.onnx and lighterglue_xfeat.onnx" in said
    assert not (tmp_path / "out").exists()
    with pytest.raises(ModelError, match=r"xfeat\.onnx is in none of nowhere"):
        LearnedFeatures("nowhere")


def test_another_network_is_refused(tmp_path: Path) -> None:
    save_network(tmp_path / FEATURES["xfeat"].extractor, [1, 3, 32, 32])
    with pytest.raises(ModelError, match="is another network: its inputs are"):
        LearnedFeatures(tmp_path)


@pytest.mark.slow
def test_the_real_networks_on_a_real_room(shared_data: Path, shared_models: Path) -> None:
    if not (shared_models / FEATURES["xfeat"].extractor).is_file():
        pytest.skip(f"{FEATURES['xfeat'].extractor} not found in {shared_models}")
    folder = shared_data / "real" / "kitchen-000"
    shot = read_shot(folder)
    images = [cv2.imread(str(p)) for p in sorted((folder / "images").iterdir())[:24:6]]
    result = reconstruct(images, camera=shot.camera, depth=None, unordered=True, features=shared_models)
    estimate = pose_arrays([frame.cam_from_world for frame in result.frames])
    errors = trajectory_errors(*estimate, shot.rotations[:24:6], shot.centers[:24:6])
    # Keypoints are whole pixels: about 2 mm at a distance of 2 m for each of some hundred.
    assert 5e-4 < errors.ate.max() < 0.004
    assert 0.3 < errors.r_rpe.max() < 1.0  # with SIFT 0.7: the cameras are only a few centimetres apart
