"""One rendered shot in many containers and codecs: the poses of each beside those of the lossless images.

    python -m benchmarks.footage

Writes `results/FOOTAGE.md`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np

import factorsfm
from benchmarks.markdown import table
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot
from tests.video_files import FORMATS, write_video

RESULT = Path(__file__).parent / "results" / "FOOTAGE.md"
FRAMES, WIDTH, HEIGHT, GRAIN = 24, 640, 360, 2.0
SEEDS = (0, 1, 2)  # of the grain of the lossless images: what it alone changes is the noise


def main() -> None:
    """Measure and write the table."""
    shot = render_shot("dolly", FRAMES, WIDTH, HEIGHT)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in SEEDS:
            rows.append([f"images, grain {seed}", "lossless", *errors(with_grain(shot, seed), shot)])
        images = with_grain(shot, SEEDS[0])
        for suffix, codec, pixels, options in FORMATS:
            path = write_video(Path(folder) / f"shot{suffix}", images, codec, pixels, options=options)
            rows.append([suffix[1:].upper(), f"{codec}, {pixels}", *errors(path, shot)])
    RESULT.write_text(report(rows), encoding="utf-8")


def with_grain(shot: RenderedShot, seed: int) -> list[np.ndarray]:
    """The images with grain that is the same in the three colours, so that subsampled colour loses little of it."""
    rng = np.random.default_rng(seed)
    grain = rng.normal(0.0, GRAIN, (len(shot.images), HEIGHT, WIDTH, 1))
    blurred = [cv2.GaussianBlur(layer, (0, 0), 0.7)[..., None] for layer in grain]
    return [np.clip(image + layer, 0, 255).astype(np.uint8) for image, layer in zip(shot.images, blurred, strict=True)]


def errors(source: Path | list[np.ndarray], shot: RenderedShot) -> list[float | int]:
    """Frames that are registered; ATE in thousandths of the path, and R-RPE in thousandths of a degree."""
    result = factorsfm.reconstruct(source, camera=shot.camera, depth=None)
    rotations, centers = pose_arrays(shot.cam_from_world)
    length = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
    found = trajectory_errors(
        *pose_arrays([frame.cam_from_world for frame in result.frames]), rotations, centers / length
    )
    return [len(result.registered), 1e3 * float(np.sqrt(np.mean(found.ate**2))), 1e3 * float(np.median(found.r_rpe))]


def report(rows: list[list[object]]) -> str:
    """The table as Markdown."""
    header = ("container", "codec, pixels", "frames", "ATE, thousandths of the path", "R-RPE, thousandths of a degree")
    return "\n".join(
        [
            "# Containers and codecs", "",
            "`python -m benchmarks.footage`", "",
            f"A rendered dolly ({FRAMES} frames of {WIDTH}x{HEIGHT}, with grain), known lens, no depth prior. The "
            "first rows are lossless images with other grain: how far they differ is the noise.", "",
            table(header, rows), "",
        ]
    )  # fmt: skip


if __name__ == "__main__":
    main()
