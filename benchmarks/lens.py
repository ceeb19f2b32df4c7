"""Unknown lenses: focal length and poses of each shot without its camera, and of shots distorted by known lenses.

    python -m benchmarks.lens --data FOLDER --models FOLDER

A shot can also be reversed, halved or thinned out, which gives tracks on which nothing was tuned. The data folder is
that of `benchmarks.inputs`. Rows that are not measured now stay as they are (`results/lens.json`).
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
from benchmarks.rows import KeptRows, Row, rows_table
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.noise import coordinate_sigma
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized, with_focal
from factorsfm.evaluation.metrics import auc, relative_pose_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import Shot
from factorsfm.lens.camera_model import with_distortion
from factorsfm.support.options import PolishOptions

_SEVEN, _TWO = ("d01", "d03", "d04", "d05", "d07", "d08", "d10"), ("d04", "d07")
DISTORTIONS = {  # k1, k2, and shots
    (-0.3, 0.08): ("d01", "d04", "d06", "d07"),
    (-0.15, 0.02): _SEVEN,
    (0.08, 0.0): _TWO,
}
_HELD = " focal length given"  # end of the names of rows
PARTS = ("reversed", "every second frame", "first half", "second half")
_FOCAL_STEP = 1.005  # factor by which a focal length is increased until no pixel is empty
_FOCAL_ERRORS = np.linspace(0.95, 1.05, 401)  # relative, that are tried to explain a difference of two lenses


class Distorted:
    """A shot as a lens with radial distortion records it: iterate for its frames, call for its masks."""

    def __init__(self, shot: Shot, lens: pycolmap.Camera) -> None:
        x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
        uv = normalized_from_pixels(lens, np.stack([x.ravel(), y.ravel()], 1).astype(np.float64))
        self._source = pixels_from_normalized(shot.camera, uv).reshape(*x.shape, 2).astype(np.float32)
        self._shot = shot
        self._masks = factorsfm.MaskFolder(shot.masks) if shot.masks is not None else None

    def __iter__(self) -> Iterator[factorsfm.Frame]:
        for frame in self._shot.frames():
            yield replace(frame, image=np.asarray(self._seen(frame.image, cv2.INTER_CUBIC), np.uint8))

    def __call__(self, frame: factorsfm.Frame) -> NDArray[np.bool_] | None:
        mask = self._masks(frame) if self._masks is not None else None
        return None if mask is None else self._seen(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0

    def _seen(self, image: NDArray[np.uint8], interpolation: int) -> cv2.typing.MatLike:
        return cv2.remap(image, self._source, None, interpolation, borderMode=cv2.BORDER_REPLICATE)


class Part:
    """Some frames of a shot: one of `PARTS`."""

    def __init__(self, shot: Shot, name: str) -> None:
        frames = list(shot.frames())
        middle = len(frames) // 2
        cuts = (slice(None, None, -1), slice(None, None, 2), slice(None, middle), slice(middle, None))
        self._frames = frames[dict(zip(PARTS, cuts, strict=True))[name]]

    def __iter__(self) -> Iterator[factorsfm.Frame]:
        for index, frame in enumerate(self._frames):
            yield replace(frame, index=index)


def true_lens(shot: Shot, k1: float, k2: float) -> pycolmap.Camera:
    """A lens with distortion k1, k2 and the shortest focal length with which its image lies within that of the shot."""
    focal, size = shot.camera.mean_focal_length(), np.array([shot.camera.width, shot.camera.height])
    along, last = np.linspace(0.0, 1.0, 65), size - 1
    rim = [np.stack([along, np.full(65, end)], 1) for end in (0.0, 1.0)]
    edge = np.concatenate([*rim, *(side[:, ::-1] for side in rim)]) * last
    while True:
        lens = with_distortion(shot.camera, focal, np.array([k1, k2, 0.0, 0.0]))
        seen = pixels_from_normalized(shot.camera, normalized_from_pixels(lens, edge))
        if (np.abs(seen - 0.5 * last) <= 0.5 * last + 0.01).all():
            return lens
        focal *= _FOCAL_STEP


def difference_px(lens: pycolmap.Camera, truth: pycolmap.Camera, scale: float = 1.0) -> NDArray[np.float64]:
    """(n,) distances between the pixels of the same ray in two lenses, for rays over the image.

    Args:
        scale: factor on the distance of the rays from the axis of `lens`, to compensate an error of the focal length.
    """
    x, y = np.meshgrid(np.linspace(0, truth.width - 1, 33), np.linspace(0, truth.height - 1, 19))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    uv = scale * normalized_from_pixels(truth, pixels)
    return np.asarray(np.linalg.norm(pixels_from_normalized(lens, uv) - pixels, axis=1))


def bent_px(lens: pycolmap.Camera, truth: pycolmap.Camera) -> float:
    """Median difference of two lenses, pixels, without the error of the focal length: what bends straight lines."""
    return min(float(np.median(difference_px(lens, truth, scale))) for scale in _FOCAL_ERRORS)


def focal_of_true_poses(known: factorsfm.Reconstruction, shot: Shot) -> float:
    """Focal length, pixels, with which the tracks of a reconstruction fit the true poses.

    If it is not that of the true camera, poses and camera of the reference do not belong together.
    """
    frames = np.array([f.index for f in known.registered])
    found = [f.cam_from_world for f in known.registered if f.cam_from_world is not None]
    world_from_cam, centers = shot.truth(frames)
    rotation = np.swapaxes(world_from_cam, 1, 2) @ world_from_cam[0]
    translation = -np.einsum("kji,kj->ki", world_from_cam, centers - centers[0])
    points = known.points @ found[0].rotation.matrix().T + found[0].translation
    estimated = np.array([p.inverse().translation for p in found])
    size, true_size = (np.linalg.norm(c - c[0], axis=1).max() for c in (estimated, centers))
    distance = np.linalg.norm(points, axis=1)
    order = np.argsort(known.observation_point, kind="stable")
    seen, point = np.unique(known.observation_point[order], return_inverse=True)
    points, distance = points[seen], distance[seen]
    unit = float(np.median(distance))
    focal = shot.camera.mean_focal_length()
    translation *= size / max(true_size, 1e-9) / unit
    state = State(rotation, translation, points / distance[:, None], unit / distance, np.log([focal]))
    pixels = focal * normalized_from_pixels(shot.camera, known.observation_xy[order])
    observations = Observations(np.searchsorted(frames, known.observation_frame[order]), point, pixels)
    held, options, sigma = np.ones(len(frames), bool), PolishOptions(tolerance=1e-6), 3.0
    for free in (False, True, True, True):
        adjustment = BundleAdjustment(
            state, observations, options, ErrorModel(sigma), free=Free(cameras=free, focal=free, held=held)
        )
        state = adjustment.solve()
        sigma = coordinate_sigma(adjustment.reprojection_errors())
    return float(np.exp(state.log_focal[0]))


def pose_auc(result: factorsfm.Reconstruction, shot: Shot) -> str:
    """AUC of the relative poses at 1 and 5 degrees."""
    poses = [f.cam_from_world.inverse() for f in result.registered if f.cam_from_world is not None]
    truth = shot.truth(np.array([f.index for f in result.registered]))
    turns, centers = np.array([p.rotation.matrix() for p in poses]), np.array([p.translation for p in poses])
    errors = relative_pose_errors(turns, centers, *truth)
    return f"{auc(errors, 1):.1f} / {auc(errors, 5):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--shots", nargs="*", default=[f"d{k:02d}" for k in range(1, 11)], help="beginnings of names")
    parser.add_argument("--distorted", nargs="*", default=_SEVEN, help="shots that are also distorted by other lenses")
    parser.add_argument("--held", action="store_true", help="distorted shots with their focal length given")
    parser.add_argument("--parts", nargs="*", default=[], help="shots of which parts are measured, too")
    arguments = parser.parse_args()
    depth = factorsfm.DepthModel(arguments.models / NETWORK_FILES["tcmonodepth"])
    folders = sorted(arguments.data.glob("*/*"))
    rows = KeptRows("lens", report)
    for folder in folders:
        if folder.name.startswith(tuple(arguments.shots)):
            rows.keep(folder.name, shot_row(read_shot(folder), depth))
        if folder.name.startswith(tuple(arguments.parts)):
            shot = read_shot(folder)
            for part in PARTS:
                result = factorsfm.reconstruct(Part(shot, part), depth=depth, masks=shot.masks)
                rows.keep(f"{folder.name}, {part}", _found(result, shot.camera))
    for (k1, k2), names in DISTORTIONS.items():
        for folder in folders:
            if folder.name.startswith(names) and folder.name.startswith(tuple(arguments.distorted)):
                key = f"{folder.name} {k1} {k2}{_HELD * arguments.held}"
                rows.keep(key, distorted_row(read_shot(folder), depth, k1, k2, held=arguments.held))


def shot_row(shot: Shot, depth: factorsfm.DepthModel) -> Row:
    """The shot with its lens known and unknown."""
    begin = time.process_time()
    known = factorsfm.reconstruct(shot.source, camera=shot.camera, depth=depth, masks=shot.masks)
    between = time.process_time()
    result = factorsfm.reconstruct(shot.source, depth=depth, masks=shot.masks)
    seconds = time.process_time() - between
    focal = f"{shot.camera.mean_focal_length():.0f}"
    return {
        "parallax": f"{known.parallax:.3f}", "true f": focal,
        "f of true poses": f"{focal_of_true_poses(known, shot):.0f}", "AUC, lens known": pose_auc(known, shot),
        **_found(result, shot.camera), "AUC": pose_auc(result, shot), "CPU s": f"{seconds:.1f}",
        "times that with the lens known": f"{seconds / (between - begin):.2f}",
    }  # fmt: skip


def distorted_row(shot: Shot, depth: factorsfm.DepthModel, k1: float, k2: float, *, held: bool) -> Row:
    """The shot as a lens with this distortion records it, with the lens unknown, or only its focal length given."""
    truth = true_lens(shot, k1, k2)
    camera = with_focal(shot.camera, truth.mean_focal_length()) if held else None
    seen = Distorted(shot, truth)
    result = factorsfm.reconstruct(seen, camera=camera, depth=depth, masks=seen, lens="radial" if held else "auto")
    found, off = result.camera, difference_px(result.camera, truth)
    k = found.params[3:] if found.model_name == "RADIAL" else (0.0, 0.0)
    return _found(result, truth) | {
        "AUC": pose_auc(result, shot),
        "k1": f"{k[0]:.4f}", "k2": f"{k[1]:.4f}",
        "px: median": f"{np.median(off):.2f}", "largest": f"{off.max():.2f}",
        "at its own focal length": f"{bent_px(found, truth):.2f}",
    }  # fmt: skip


def _found(result: factorsfm.Reconstruction, truth: pycolmap.Camera) -> Row:
    fit = result.lens
    assert fit is not None
    error = result.camera.mean_focal_length() / truth.mean_focal_length() - 1
    return {
        "error %": f"{100 * error:+.2f}",
        "std %": f"{100 * fit.focal_std:.2f}" if fit.focal_std is not None else "-",
        "determined": "yes" if fit.determined else "no",
    }


def report(rows: dict[str, Row]) -> str:
    """The tables as Markdown."""
    plain = {key: row for key, row in rows.items() if " " not in key}
    parts = {key: row for key, row in rows.items() if key.endswith(PARTS)}
    bent = {key: row for key, row in rows.items() if " " in key and not key.endswith((_HELD, *PARTS))}
    held = {key.removesuffix(_HELD): row for key, row in rows.items() if key.endswith(_HELD)}
    return "\n".join(
        [
            "# Unknown lenses", "",
            "`python -m benchmarks.lens --data FOLDER --models FOLDER`, and the real sets with `--shots NAME ...`", "",
            "Prior: TCMonoDepth; masks where the shot has them. AUC: relative poses at 1 / 5 degrees. std: standard "
            "deviation of the focal length. Not determined: too uncertain to count as an estimate; without a std the "
            "first guess is kept. f of true poses: the focal length with which the tracks fit the true poses; if it is "
            "another one, poses and camera of the reference do not belong together. CPU s: of this process, "
            "without that of the map's graph.", "",
            *rows_table("shot", plain),
            "Parts of the same shots (`--parts NAME ...`):", "",
            *rows_table("shot, part", parts),
            "The same through unknown lenses with distortion k1, k2; their focal length is a little longer, so that "
            "the image is full. px: distance between the pixels of the same ray in the true and in the estimated lens, "
            "over the image; at its own focal length: the median of these distances without the error of the focal "
            "length.", "",
            *rows_table("shot, k1, k2", bent),
            "The same with the focal length given (`--lens radial`):", "",
            *rows_table("shot, k1, k2", held),
        ]
    )  # fmt: skip


if __name__ == "__main__":
    main()
