"""Alignment: up, ground and scale of results beside the truth of their shots.

    python -m benchmarks.ground --data FOLDER --models FOLDER [--work FOLDER]

The data folder is that of `benchmarks.inputs`. True up is z in the studio shots; in the kitchen it is the direction in
which the sensor's depth is most layered: floor, worktops and table are level. The results are kept in the work folder,
and taken from there. Distances are between random pixels, their true length from the depth maps.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import factorsfm
from benchmarks.inputs import NETWORK_FILES
from benchmarks.rows import Row, rows_table
from factorsfm.alignment.picks import length_between, picked_point
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import Shot
from factorsfm.support.rotations import exponential
from factorsfm.support.similarity import Similarity, pose_arrays
from factorsfm.support.similarity import align as align_paths

Array = NDArray[np.float64]

RESULT = Path(__file__).parent / "results" / "GROUND.md"
SHOTS = ("d01", "d02", "d03", "d04", "d05", "d06", "d07", "d08", "d09", "kitchen")
_LAYER = 0.03  # metres: thickness of what counts as one level
_DISTANCES = 40
_KITCHEN_UP = np.array([0.0, -0.9, -0.435])  # of 7-Scenes' red kitchen, to within some degrees: refined from depth


def cloud(shot: Shot, index: int, step: int = 4) -> Array | None:
    """(n, 3) true positions of the pixels of a frame, None without a depth map."""
    depth = shot.depth(index)
    if depth is None:
        return None
    height, width = depth.shape
    y, x = np.mgrid[0:height:step, 0:width:step]
    z = depth[::step, ::step].ravel().astype(np.float64)
    pixels = (np.column_stack([x.ravel(), y.ravel()]) + PIXEL_CENTER) * shot.camera.width / width
    points = np.column_stack([np.asarray(shot.camera.cam_from_img(pixels)), np.ones(len(z))]) * z[:, None]
    rotation, center = shot.truth(np.array([index]))
    return np.asarray(points[np.isfinite(z)] @ rotation[0].T + center[0])


def true_up(shot: Shot) -> Array:
    """(3,) up in the world of the truth."""
    if not shot.name.startswith("kitchen"):
        return np.array([0.0, 0.0, 1.0])
    found = [cloud(shot, int(index)) for index in shot.indices[::6]]
    points = np.concatenate([part for part in found if part is not None])
    up = _KITCHEN_UP / np.linalg.norm(_KITCHEN_UP)
    for reach in (4.0, 1.0, 0.3):
        steps = np.radians(np.linspace(-reach, reach, 17))
        x = np.cross(up, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        y = np.cross(up, x)
        tried = [exponential((a * x + b * y)[None])[0] @ up for a in steps for b in steps]
        up = max(tried, key=lambda direction: _layering(points @ direction))
    return np.asarray(up)


def _layering(height: Array) -> float:
    counts = np.bincount(((height - height.min()) / _LAYER).astype(int))
    return float((counts.astype(float) ** 2).sum())


def shot_row(shot: Shot, result: factorsfm.Reconstruction) -> Row:
    """Errors of up and of the height above the ground, and normalised errors of scales from distances."""
    aligned = factorsfm.align(result, footage=shot.source)
    known = aligned.alignment
    assert known is not None
    poses = pose_arrays([frame.cam_from_world for frame in aligned.registered])
    truth = shot.truth(np.array([frame.index for frame in aligned.registered]))
    world, up = align_paths(*poses, *truth), true_up(shot)
    row: Row = {"up from": ", ".join(known.up_from) or "not known", "up std °": "–", "up error °": "–"}
    if known.up_std is not None:
        angle = np.degrees(np.arccos(np.clip(world.rotation @ [0.0, -1.0, 0.0] @ up, -1, 1)))
        row |= {"up std °": f"{known.up_std:.2f}", "up error °": f"{angle:.2f}"}
    row |= {"ground, points": "not known", "height m": "–", "true height m": "–"}
    if known.camera_height is not None and known.ground_std is not None:
        height, std = world.scale * known.camera_height, world.scale * known.ground_std
        row["ground, points"], row["height m"] = str(known.ground_points), f"{height:.2f} ± {std:.2f}"
        row["true height m"] = f"{_true_height(shot, aligned.registered[0].index, up, height):.2f}"
    return row | _distances(shot, result)


def _true_height(shot: Shot, index: int, up: Array, near: float) -> float:
    """Of the camera above the true level with most pixels around the one found."""
    points = next(p for k in (index, index + 1) if (p := cloud(shot, k)) is not None)
    below = (shot.truth(np.array([index]))[1][0] - points) @ up
    below = below[np.abs(below - near) < 0.3]
    if not len(below):
        return float("nan")
    counts = np.bincount(((below - below.min()) / _LAYER).astype(int))
    level = below.min() + _LAYER * (np.argmax(counts) + 0.5)
    return float(np.median(below[np.abs(below - level) < 1.5 * _LAYER]))


def _distances(shot: Shot, result: factorsfm.Reconstruction) -> Row:
    poses = pose_arrays([frame.cam_from_world for frame in result.registered])
    world = align_paths(*poses, *shot.truth(np.array([frame.index for frame in result.registered])))
    generator = np.random.default_rng(0)
    errors, stds, refused = [], [], 0
    frames = [frame for frame in result.registered if shot.depth(frame.index) is not None]
    for _ in range(_DISTANCES):
        frame = frames[generator.integers(len(frames))]
        try:
            scale, std = _scale(shot, result, frame.index, generator)
        except factorsfm.InputError:
            refused += 1
            continue
        errors.append(scale / world.scale - 1)
        stds.append(std)
    if not errors:
        return {"distances": f"0 of {_DISTANCES}"}
    sigmas = np.abs(errors) / np.array(stds)
    return {
        "distances": f"{len(errors)} of {_DISTANCES}",
        "scale error %": f"{100 * np.median(np.abs(errors)):.1f}",
        "scale std %": f"{100 * np.median(stds):.1f}",
        "within 1, 2 std %": f"{100 * np.mean(sigmas < 1):.0f}, {100 * np.mean(sigmas < 2):.0f}",
    }


def _scale(
    shot: Shot, result: factorsfm.Reconstruction, index: int, generator: np.random.Generator
) -> tuple[float, float]:
    """Metres in a unit of the result, and its relative standard deviation, from one distance in a frame."""
    depth = shot.depth(index)
    assert depth is not None
    factor = shot.camera.width / depth.shape[1]
    rotation, center = shot.truth(np.array([index]))
    world = Similarity(1.0, rotation[0], center[0])
    picks, places = [], []
    while len(picks) < 2:
        row, column = generator.integers(depth.shape[0]), generator.integers(depth.shape[1])
        if not np.isfinite(depth[row, column]):
            continue
        pixel = (np.array([column, row]) + PIXEL_CENTER) * factor
        ray = np.append(np.asarray(shot.camera.cam_from_img(pixel[None])).ravel(), 1.0)
        places.append(world.points(float(depth[row, column]) * ray[None])[0])
        picks.append(factorsfm.Pick(index, *(pixel - PIXEL_CENTER)))
    length = float(np.linalg.norm(places[1] - places[0]))
    found, std = length_between(*(picked_point(result, pick) for pick in picks))
    return length / found, std / found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--shots", nargs="*", default=SHOTS, help="beginnings of names")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    depth = factorsfm.DepthModel(arguments.models / NETWORK_FILES["tcmonodepth"])
    rows: dict[str, Row] = {}
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        for folder in sorted(arguments.data.glob("*/*")):
            if not folder.name.startswith(tuple(arguments.shots)):
                continue
            shot = read_shot(folder)
            if not (work / folder.name).exists():
                solved = factorsfm.reconstruct(shot.source, camera=shot.camera, depth=depth)
                solved.write(work / folder.name)
            rows[folder.name] = shot_row(shot, factorsfm.read_result(work / folder.name))
            print(folder.name, rows[folder.name], flush=True)
    RESULT.write_text(report(rows), encoding="utf-8")


def report(rows: dict[str, Row]) -> str:
    """The table with what it shows."""
    lines = [
        "# Alignment",
        "",
        "`python -m benchmarks.ground` makes this table: the default `align` of results with known lens beside the",
        "truth. Heights are those of the first camera above the ground, in true metres. A distance is one between two",
        "random pixels of a frame, edges of things and things that move included; pixels with too few tracks",
        "around them are refused.",
        "",
        *rows_table("shot", rows),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
