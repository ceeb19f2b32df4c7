"""Accuracy from files to files on footage that is made here: rendered, with exact truth, and degraded.

The bounds stand on both sides of what was measured: accuracy must not decay unseen where no real footage is at hand.
"""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm import DepthFolder, DepthKind, Frame, Reconstruction
from factorsfm.evaluation.degrade import degraded_frames
from factorsfm.evaluation.metrics import TrajectoryErrors, trajectory_errors
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import Motion, RenderedShot, render_shot, simulate_prior
from tests.video_files import write_video

SIZE = (480, 270)


def write_degraded(shot: RenderedShot, order: np.ndarray, folder: Path) -> list[np.ndarray]:
    """The images in some order through a soft lens, a noisy sensor and strong compression; ``depth/`` of a network."""
    maps = simulate_prior(shot)
    (folder / "depth").mkdir()
    for number, k in enumerate(order):
        np.save(folder / "depth" / f"{number:06d}.npy", maps[k])
    frames = [Frame(number, shot.images[k], f"{number:06d}") for number, k in enumerate(order)]
    return [frame.image for frame in degraded_frames(frames, blur=0.8, noise=6.0, jpeg_quality=50)]


def errors_of(poses: list[pycolmap.Rigid3d | None], shot: RenderedShot, order: np.ndarray) -> TrajectoryErrors:
    """Lengths as a share of the largest distance from the first camera of the shot."""
    rotations, centers = pose_arrays(shot.cam_from_world)
    extent = np.linalg.norm(centers - centers[0], axis=1).max()
    return trajectory_errors(*pose_arrays(poses), rotations[order], centers[order] / extent)


def depths_within(result: Reconstruction, shot: RenderedShot, order: np.ndarray, share: float) -> float:
    """Share of the observations whose point has nearly the true depth, apart from one scale for all."""
    row, column = np.rint(result.observation_xy).astype(int).T[::-1]
    true = np.array(
        [shot.depths[order[k]][y, x] for k, y, x in zip(result.observation_frame, row, column, strict=True)]
    )
    rays = result.points[result.observation_point] - result.camera_centers()[result.observation_frame]
    axes = np.array([frame.cam_from_world.rotation.matrix()[2] for frame in result.frames])
    ratio = np.einsum("ni,ni->n", rays, axes[result.observation_frame]) / true
    return float((np.abs(ratio / np.median(ratio) - 1.0) < share).mean())


@pytest.mark.parametrize(
    ("motion", "parallax", "as_given", "polished", "turned", "depth"),
    [
        ("handheld", 0.03, (0.006, 0.02), (0.0014, 0.0036), (0.0032, 0.0080), (0.70, 0.87)),
        ("dolly", 0.05, (0.0009, 0.0025), (0.0007, 0.0018), (0.0016, 0.0042), (0.55, 0.73)),
    ],
)
def test_a_video(
    motion: Motion,
    parallax: float,
    as_given: tuple[float, float],
    polished: tuple[float, float],
    turned: tuple[float, float],
    depth: tuple[float, float],
    tmp_path: Path,
) -> None:
    shot, order = render_shot(motion, 16, *SIZE, parallax), np.arange(16)
    images = write_degraded(shot, order, tmp_path)
    video = cv2.VideoWriter(str(tmp_path / "shot.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 24, SIZE)
    for image in images:
        video.write(image)
    video.release()
    prior = DepthFolder(tmp_path / "depth", DepthKind.INVERSE)
    with factorsfm.track(tmp_path / "shot.mp4", camera=shot.camera, depth=prior) as live:
        causal = errors_of([update.cam_from_world for update in live], shot, order)
        live.finish().write(tmp_path / "result")
    result = factorsfm.read_result(tmp_path / "result")
    errors = errors_of([frame.cam_from_world for frame in result.frames], shot, order)
    assert len(result.registered) == 16
    assert as_given[0] < np.median(causal.ate) < as_given[1]
    assert polished[0] < np.median(errors.ate) < polished[1]
    assert turned[0] < np.median(errors.r_rpe) < turned[1]  # degrees
    assert depth[0] < depths_within(result, shot, order, 0.02) < depth[1]


def test_a_stream_that_lost_packets(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Decoders fill up what is missing from the frames before, and mark only some of these frames."""
    shot = render_shot("truck", 36, 320, 180, 0.08)
    path = write_video(tmp_path / "shot.ts", shot.images, options={"crf": "20", "g": "12"}, rate=24)
    data, lost = path.read_bytes(), np.random.default_rng(3)
    packets = [data[k : k + 188] for k in range(0, len(data), 188)]
    path.write_bytes(b"".join(p for k, p in enumerate(packets) if k < len(packets) // 5 or lost.random() > 0.01))
    result = factorsfm.reconstruct(path, camera=shot.camera, depth=None)
    (said,) = {message for message in caplog.messages if "damaged" in message}
    assert "frames that cannot be read" in said
    order = np.array([frame.index for frame in result.registered])
    assert 28 <= len(order) < 36
    errors = errors_of([frame.cam_from_world for frame in result.registered], shot, order)
    assert 0.005 < np.median(errors.ate) < 0.03  # 0.0015 without losses
    assert errors.ate.max() < 0.08


def test_a_set(tmp_path: Path) -> None:
    shot, order = render_shot("arc", 8, *SIZE, 0.3), np.random.default_rng(0).permutation(8)
    (tmp_path / "images").mkdir()
    for number, image in enumerate(write_degraded(shot, order, tmp_path)):
        cv2.imwrite(str(tmp_path / "images" / f"{number:06d}.png"), image)
    prior = DepthFolder(tmp_path / "depth", DepthKind.INVERSE)
    found = factorsfm.reconstruct(tmp_path / "images", camera=shot.camera, depth=prior, unordered=True)
    found.write(tmp_path / "result")
    result = factorsfm.read_result(tmp_path / "result")
    errors = errors_of([frame.cam_from_world for frame in result.frames], shot, order)
    assert len(result.registered) == 8
    assert 1.4e-4 < np.median(errors.ate) < 4.2e-4
    assert 0.008 < np.median(errors.r_rpe) < 0.025  # degrees
    assert 0.85 < depths_within(result, shot, order, 0.02) < 0.95
