"""Rolling shutter: the estimated readouts of shots with a known one and of real clips, and their effect on the poses.

    python -m benchmarks.rolling --data FOLDER --models FOLDER

The data folder is that of `benchmarks.inputs`. The studio shots are read row by row with their true depth and poses
(`factorsfm.synthetic.read_by_rows`); the real clips are used as they are. Rows that are not measured now stay as they
are (`results/rolling.json`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

import factorsfm
from benchmarks.inputs import NETWORK_FILES
from benchmarks.lens import pose_auc
from benchmarks.rows import KeptRows, Row, rows_table
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import Shot
from factorsfm.support.options import ShutterUse
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import read_by_rows

READOUTS = {"d03": 0.9, "d05": 0.4, "d07": 0.6, "d10": 0.9}
REAL = ("desk", "hololens", "kitchen", "tsukuba")
USES = get_args(ShutterUse)


class Rolled:
    """The frames of a shot as a rolling shutter reads them."""

    def __init__(self, shot: Shot, readout: float) -> None:
        frames = list(shot.frames())
        rotation, center = shot.truth(np.array([frame.index for frame in frames]))
        path = [pycolmap.Rigid3d(pycolmap.Rotation3d(r), c).inverse() for r, c in zip(rotation, center, strict=True)]
        self._frames = []
        for k, frame in enumerate(frames):
            known = shot.depth(frame.index)
            known = shot.depth(frame.index - 1) if known is None else known  # every second frame has depth
            assert known is not None
            image = read_by_rows(frame.image, _filled(known), shot.camera, path, k, readout)
            self._frames.append(replace(frame, image=image))

    def __iter__(self) -> Iterator[factorsfm.Frame]:
        return iter(self._frames)


def _filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The depth map with its largest depth where it is unknown."""
    far = float(np.nanmax(np.where(np.isfinite(depth), depth, 0.0)))
    return np.where(np.isfinite(depth), depth, np.float32(far)).astype(np.float32)


def shot_row(shot: Shot, depth: factorsfm.DepthModel, readout: float | None) -> Row:
    """A shot with each `ShutterUse`, its lens known and unknown.

    Args:
        readout: with which the shot is read row by row; None for a clip that is used as it is.
    """
    source = shot.source if readout is None else Rolled(shot, readout)
    row: Row = {"readout": "" if readout is None else f"{readout:.2f}"}

    def solved(use: ShutterUse, camera: pycolmap.Camera | None) -> factorsfm.Reconstruction:
        return factorsfm.reconstruct(source, camera=camera, depth=depth, masks=shot.masks, shutter=use)

    known = {use: solved(use, shot.camera) for use in USES}
    open_lens = {use: solved(use, None) for use in USES if use != "rolling"}
    row["found"] = _readout(known["auto"])
    row |= {f"ATE mm, {use}": f"{_ate(known[use], shot):.2f}" for use in USES}
    row |= {f"AUC, {use}": pose_auc(known[use], shot) for use in USES}
    row["px, global"], row["px, rolling"] = (
        f"{np.median(known[use].observation_error):.3f}" for use in ("global", "rolling")
    )
    if readout is None:
        row |= {f"depth spread %, {use}": _depth_spread(known[use], shot) for use in ("global", "rolling")}
    row["found, lens unknown"] = _readout(open_lens["auto"])
    row |= {f"f error %, {use}": _focal(result, shot) for use, result in open_lens.items()}
    return row


def _readout(result: factorsfm.Reconstruction) -> str:
    fit = result.shutter
    return "none" if fit is None else f"{fit.readout:.3f} ± {fit.std:.3f}{'' if fit.along == 'rows' else ' columns'}"


def _focal(result: factorsfm.Reconstruction, shot: Shot) -> str:
    fit, error = result.lens, result.camera.mean_focal_length() / shot.camera.mean_focal_length() - 1
    assert fit is not None
    std = f" ± {100 * fit.focal_std:.2f}" if fit.focal_std is not None else ""
    return f"{100 * error:+.2f}{std}{'' if fit.determined else ' (not determined)'}"


def _ate(result: factorsfm.Reconstruction, shot: Shot) -> float:
    poses = pose_arrays([f.cam_from_world for f in result.registered if f.cam_from_world is not None])
    errors = trajectory_errors(*poses, *shot.truth(np.array([f.index for f in result.registered])))
    return 1e3 * float(np.sqrt(np.mean(errors.ate**2)))


def _depth_spread(result: factorsfm.Reconstruction, shot: Shot) -> str:
    """Robust standard deviation of the ratio between the depths of the points and those of the sensor, percent."""
    ratios = []
    for position, frame in enumerate(result.frames):
        depth = shot.depth(frame.index)
        if frame.cam_from_world is None or depth is None:
            continue
        mine = result.observation_frame == position
        z = (frame.cam_from_world * result.points[result.observation_point[mine]])[:, 2]
        x, y = np.round(result.observation_xy[mine]).astype(int).T
        sensor = depth[np.clip(y, 0, depth.shape[0] - 1), np.clip(x, 0, depth.shape[1] - 1)]
        seen = np.isfinite(sensor) & (z > 0)
        ratios.append(np.log(z[seen] / sensor[seen]))
    if not ratios:
        return "–"
    ratio = np.concatenate(ratios)
    return f"{148.26 * np.median(np.abs(ratio - np.median(ratio))):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--shots", nargs="*", default=[*READOUTS, *REAL], help="beginnings of names")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    depth = factorsfm.DepthModel(arguments.models / NETWORK_FILES["tcmonodepth"])
    rows = KeptRows("rolling", report)
    for folder in sorted(arguments.data.glob("*/*")):
        if folder.name.startswith(tuple(arguments.shots)):
            readout = next((r for name, r in READOUTS.items() if folder.name.startswith(name)), None)
            rows.keep(folder.name, shot_row(read_shot(folder), depth, readout))


def report(rows: dict[str, Row]) -> str:
    """The tables as Markdown."""
    simulated = {name: row for name, row in rows.items() if row["readout"]}
    real = {name: {k: v for k, v in row.items() if k != "readout"} for name, row in rows.items() if not row["readout"]}
    return "\n".join(
        [
            "# Rolling shutter", "",
            "`python -m benchmarks.rolling --data FOLDER --models FOLDER`", "",
            "Each shot with `shutter` global (a global shutter is assumed), auto (poses of a global shutter that fit "
            "the recorded images) and rolling (poses at the time when the middle of the image is read). Readout: time "
            "from the first row to the last, in frames. ATE: root mean square after alignment; AUC: relative poses at "
            "1 / 5 degrees; px: median reprojection error; depth spread: robust standard deviation of the ratio "
            "between the depths of the points and those of a depth sensor. Then the same without a camera: error of "
            "the focal length and its standard deviation.", "",
            "Studio shots, read row by row with a known readout; the truth is that of the middle of the image:", "",
            *rows_table("shot", simulated),
            "Real clips. The reference of the kitchens is a reconstruction that assumes a global shutter and has its "
            "errors; that of the HoloLens is its head tracking. tsukuba is rendered with a global shutter.", "",
            *rows_table("shot", real),
        ]
    )  # fmt: skip


if __name__ == "__main__":
    main()
