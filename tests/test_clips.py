"""Whole reconstructions against the truth: clips with a real network, and every preset on rendered shots."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm import PRESETS, DepthModel, ShotKind
from factorsfm.evaluation.metrics import TrajectoryErrors, trajectory_errors
from factorsfm.evaluation.readers import Shot, read_shot
from factorsfm.export.formats import export
from factorsfm.result.summary import focal_range
from factorsfm.support.similarity import pose_arrays
from tests.rendered import FRAMES, Maps, errors_of, quick_presets, rendered, simulated_maps

NETWORK = "tcmonodepth_tcsmallnet_192x320.onnx"
FADE = 10  # frames


def against_truth(result: factorsfm.Reconstruction, shot: Shot) -> TrajectoryErrors:
    indices = np.array([frame.index for frame in result.frames])
    return trajectory_errors(*pose_arrays([frame.cam_from_world for frame in result.frames]), *shot.truth(indices))


def test_a_real_clip_with_a_real_network(shared_data: Path, shared_models: Path) -> None:
    """7-Scenes kitchen; measured 0.88 mm and 0.033 degrees, about the noise of the reference."""
    shot = read_shot(shared_data / "real" / "kitchen-528")
    result = factorsfm.reconstruct(shot.source, camera=shot.camera, depth=DepthModel(shared_models / NETWORK))
    errors = against_truth(result, shot)
    assert len(result.registered) == len(result.frames) == 24
    assert 0.0004 < np.median(errors.ate) < 0.0014
    assert 0.001 < errors.ate.max() < 0.005
    assert 0.015 < np.median(errors.r_rpe) < 0.05
    assert 0.04 < result.parallax < 0.075
    assert sum(frame.prior is not None for frame in result.frames) >= 2
    assert len(result.points) > 800


def test_a_handheld_shot_of_very_small_parallax(shared_data: Path, shared_models: Path) -> None:
    """First 20 frames of d03; measured 0.22 mm on a path of some centimetres, and 0.003 degrees."""
    shot = read_shot(shared_data / "studiosim" / "d03_livingroom_handheld")
    result = factorsfm.reconstruct(
        shot.source, camera=shot.camera, depth=DepthModel(shared_models / NETWORK), frames=slice(0, 20)
    )
    errors = against_truth(result, shot)
    assert len(result.registered) == len(result.frames) == 20
    assert result.kind is ShotKind.GENERAL
    assert 0.0001 < np.median(errors.ate) < 0.0004
    assert 0.0015 < np.median(errors.r_rpe) < 0.006
    assert 0.008 < result.parallax < 0.015


@pytest.mark.slow
def test_a_zoom_that_nobody_announced(shared_data: Path) -> None:
    """It goes from 628 to 942 pixels while the camera moves in the hand; with one focal length, half of it moves."""
    clip = shared_data.parent / "cases" / "zoom_unannounced" / "shot.mp4"
    if not clip.is_file():
        pytest.skip(f"the clip {clip} is not there")
    result = factorsfm.reconstruct(clip, depth=None)
    shortest, longest = focal_range(result)
    assert shortest == pytest.approx(628, rel=0.02)
    assert longest == pytest.approx(942, rel=0.02)
    assert 0.045 < result.parallax < 0.065
    assert result.moving is None
    assert any("Nobody announced this zoom" in note for note in result.notes)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("motion", ["handheld", "arc"])
def test_every_preset_registers_every_frame(motion, preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())
    shot = rendered(motion)
    result = factorsfm.reconstruct(shot.images, camera=shot.camera, depth=Maps(simulated_maps(motion)), preset=preset)
    errors = errors_of(result, shot)
    assert len(result.registered) == FRAMES
    assert result.kind is ShotKind.GENERAL
    assert 2e-4 < np.median(errors.ate) < 0.003  # share of the path's length
    assert 0.0015 < np.median(errors.r_rpe) < 0.03
    assert result.options["preset"] == preset
    # the prior takes part in the polish of the default preset alone
    assert any(frame.prior is not None for frame in result.frames) == (preset == "default")

    result.write(tmp_path / "out")
    assert_readable(result, tmp_path / "out")


def assert_readable(result: factorsfm.Reconstruction, folder: Path) -> None:
    """The files say what the result says, as other programs read them."""
    model = pycolmap.Reconstruction(folder / "colmap")
    assert (model.num_reg_images(), model.num_points3D()) == (len(result.registered), len(result.points))
    poses = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    assert len(poses) == len(result.registered)
    for frame in result.registered:
        (pose,) = (poses[name] for name in poses if Path(name).stem == frame.name)
        np.testing.assert_allclose(pose, frame.cam_from_world.matrix(), atol=1e-9)
    np.testing.assert_allclose(
        np.sort(reprojection_errors(model)), np.sort(result.observation_error), rtol=0.0, atol=3e-6
    )

    trajectory = np.loadtxt(folder / "trajectory.tum")
    np.testing.assert_array_equal(trajectory[:, 0], [frame.index for frame in result.registered])
    np.testing.assert_allclose(trajectory[:, 1:4], result.camera_centers(), rtol=0.0, atol=1e-10)
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["registered"], summary["points"]) == (len(result.registered), len(result.points))
    assert summary["parallax"] == pytest.approx(result.parallax)
    header = (folder / "points.ply").read_bytes()[:200]
    assert f"element vertex {len(result.points)}\n".encode() in header
    assert (folder / "report.html").stat().st_size > 10_000


def reprojection_errors(model: pycolmap.Reconstruction) -> np.ndarray:
    """Of every observation, as COLMAP projects it (pixels)."""
    errors = []
    for image in model.images.values():
        for point2d in image.get_observation_points2D():
            projected = image.project_point(model.points3D[point2d.point3D_id].xyz)
            errors.append(np.linalg.norm(projected - point2d.xy))
    return np.array(errors)


def test_a_fade_in_spoils_nothing(shared_data: Path, shared_models: Path, tmp_path: Path) -> None:
    """The clip after ten dimmed stills: the same error, and all that is written holds what is known and no more."""
    shot = read_shot(shared_data / "real" / "kitchen-528")
    clip = [frame.image for frame in shot.frames()]
    fade = [cv2.convertScaleAbs(clip[0], alpha=(k + 1) / 80) for k in range(FADE)]
    folder = tmp_path / "images"
    folder.mkdir()
    for k, image in enumerate([*fade, *clip]):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image)
    result = factorsfm.reconstruct(folder, camera=shot.camera, depth=DepthModel(shared_models / NETWORK))
    own, dark = result.frames[FADE:], result.frames[:FADE]
    truth = shot.truth(np.arange(len(clip)))
    errors = trajectory_errors(*pose_arrays([frame.cam_from_world for frame in own]), *truth)
    assert 0.0004 < np.median(errors.ate) < 0.0014
    assert not dark[0].registered
    assert all(" of " in frame.message and " needed " in frame.message for frame in dark if not frame.registered)
    seen = np.bincount(result.observation_frame, minlength=len(result.frames))
    for k, frame in enumerate(result.frames):
        twin = k - (frame.repeats is not None)  # the recorder has given some images twice
        assert (
            frame.registered
            == (seen[twin] >= 15)
            == (frame.covariance is not None)
            == (frame.observability is not None)
        )
        assert frame.covariance is None or np.isfinite(frame.covariance).all()
    repeating = [frame.index - FADE for frame in result.frames if frame.repeats is not None]
    assert repeating == [k for k in range(1, len(clip)) if (clip[k] == clip[k - 1]).all()] == [3, 7, 12, 18, 22]
    first = result.registered[0].cam_from_world
    np.testing.assert_allclose(first.matrix(), np.eye(3, 4), atol=1e-12)

    result.write(tmp_path / "result")
    summary = json.loads((tmp_path / "result" / "summary.json").read_text())
    assert summary["registered"] == len(result.registered)
    for name in ("colmap", "nuke", "tum", "ply"):
        export(result, tmp_path / f"export.{name}", format=name)
    more = factorsfm.add_images(tmp_path / "result", [clip[5]])
    added = more.frames[-1].cam_from_world
    offset = (added * own[5].cam_from_world.inverse()).matrix() - np.eye(3, 4)
    assert 5e-5 < np.abs(offset).max() < 8e-4
