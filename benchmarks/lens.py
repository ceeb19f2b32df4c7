"""Unknown lenses: focal length and poses of each shot without its camera, and shots distorted by a known lens.

    python -m benchmarks.lens --data FOLDER --models FOLDER

FOLDER/studiosim and FOLDER/real hold the shots with their truth (`benchmarks.inputs`).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

import factorsfm
from benchmarks.inputs import NETWORK_FILES
from factorsfm.camera import normalized_from_pixels, pixels_from_normalized, with_lens
from factorsfm.evaluation.metrics import auc, relative_pose_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import Shot

DISTORTED = ("d04", "d07")
DISTORTION = np.array([-0.15, 0.02, 0.0, 0.0])
_LONGER = 1.005
RESULT = Path(__file__).parent / "results" / "LENS.md"


def distorted_frames(shot: Shot) -> Iterator[factorsfm.Frame]:
    """The frames as a lens with radial distortion would have seen them."""
    lens = true_lens(shot)
    x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    uv = normalized_from_pixels(lens, np.stack([x.ravel(), y.ravel()], 1).astype(np.float64))
    source = pixels_from_normalized(shot.camera, uv).reshape(lens.height, lens.width, 2).astype(np.float32)
    for frame in shot.frames():
        image = cv2.remap(frame.image, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        yield replace(frame, image=np.asarray(image, np.uint8))


def true_lens(shot: Shot) -> pycolmap.Camera:
    """The lens of the distorted shot, just long enough that it sees nothing outside the frames that there are."""
    focal, size = shot.camera.mean_focal_length(), np.array([shot.camera.width, shot.camera.height])
    along, last = np.linspace(0.0, 1.0, 65), size - 1
    rim = [np.stack([along, np.full(65, end)], 1) for end in (0.0, 1.0)]
    edge = np.concatenate([*rim, *(side[:, ::-1] for side in rim)]) * last
    while True:
        lens = with_lens(shot.camera, focal, DISTORTION)
        seen = pixels_from_normalized(shot.camera, normalized_from_pixels(lens, edge))
        if (np.abs(seen - 0.5 * last) <= 0.5 * last + 0.01).all():
            return lens
        focal *= _LONGER


def difference_px(lens: pycolmap.Camera, truth: pycolmap.Camera) -> NDArray[np.float64]:
    """Between the pixels of the same ray in both lenses, over the image."""
    x, y = np.meshgrid(np.linspace(0, truth.width - 1, 33), np.linspace(0, truth.height - 1, 19))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    uv = normalized_from_pixels(truth, pixels)
    return np.asarray(np.linalg.norm(pixels_from_normalized(lens, uv) - pixels, axis=1))


def pose_auc(result: factorsfm.Reconstruction, shot: Shot) -> str:
    """AUC of the relative poses at 1 and 5 degrees."""
    poses = [f.cam_from_world.inverse() for f in result.registered if f.cam_from_world is not None]
    truth = shot.truth(np.array([f.index for f in result.registered]))
    turns, centers = np.array([p.rotation.matrix() for p in poses]), np.array([p.translation for p in poses])
    errors = relative_pose_errors(turns, centers, *truth)
    return f"{auc(errors, 1):.1f} / {auc(errors, 5):.1f}"


def main() -> None:
    """Measure the shots and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--shots", nargs="+", default=[f"d{k:02d}" for k in range(1, 11)], help="beginnings of names")
    arguments = parser.parse_args()
    depth = factorsfm.DepthModel(arguments.models / NETWORK_FILES["tcmonodepth"])
    folders = [f for f in sorted(arguments.data.glob("*/*")) if f.name.startswith(tuple(arguments.shots))]
    rows = []
    for folder in folders:
        shot = read_shot(folder)
        known = factorsfm.reconstruct(shot.source, camera=shot.camera, depth=depth)
        begin = time.perf_counter()
        result = factorsfm.reconstruct(shot.source, depth=depth)
        seconds = time.perf_counter() - begin
        rows.append(_row(folder.name, shot, known, result, seconds))
        print(rows[-1], flush=True)
    text = [
        "# Unknown lenses", "",
        f"`python -m benchmarks.lens --data FOLDER --models FOLDER --shots {' '.join(arguments.shots)}`", "",
        "Prior: TCMonoDepth. AUC: of the relative poses at 1 / 5 degrees. std: of the focal length.", "",
        "| shot | parallax | true f | estimate | error % | std % | determined | AUC, lens known | AUC, unknown | s |",
        "|---|---|---|---|---|---|---|---|---|---|", *rows, "",
    ]  # fmt: skip
    text += [
        f"The same distorted by k1 = {DISTORTION[0]}, k2 = {DISTORTION[1]}, and unknown; the focal length is "
        "a little longer, so that the image is full:", "",
        "| shot | focal error % | std % | k1 | k2 | over the image: median, largest px | AUC |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for folder in folders:
        if folder.name[:3] in DISTORTED:
            text.append(_distorted_row(folder.name, read_shot(folder), depth))
            print(text[-1], flush=True)
    RESULT.write_text("\n".join(text) + "\n")


def _row(
    name: str, shot: Shot, known: factorsfm.Reconstruction, result: factorsfm.Reconstruction, seconds: float
) -> str:
    fit, truth, focal = result.lens, shot.camera.mean_focal_length(), result.camera.mean_focal_length()
    assert fit is not None
    std = f"{100 * fit.focal_std:.2f}" if fit.focal_std is not None else "-"
    return (
        f"| {name} | {known.parallax:.3f} | {truth:.0f} | {focal:.0f} | {100 * (focal / truth - 1):+.2f} | {std} "
        f"| {'yes' if fit.determined else 'no'} | {pose_auc(known, shot)} | {pose_auc(result, shot)} | {seconds:.0f} |"
    )


def _distorted_row(name: str, shot: Shot, depth: factorsfm.DepthModel) -> str:
    result = factorsfm.reconstruct(distorted_frames(shot), depth=depth)
    truth, fit = true_lens(shot), result.lens
    assert fit is not None
    off = difference_px(result.camera, truth)
    focal = result.camera.mean_focal_length() / truth.mean_focal_length()
    std = f"{100 * fit.focal_std:.2f}" if fit.focal_std is not None else "-"
    k1, k2 = result.camera.params[3:] if result.camera.model_name == "RADIAL" else (0.0, 0.0)
    return (
        f"| {name} | {100 * (focal - 1):+.2f} | {std} | {k1:.4f} | {k2:.4f} | {np.median(off):.2f}, {off.max():.2f} "
        f"| {pose_auc(result, shot)} |"
    )


if __name__ == "__main__":
    main()
