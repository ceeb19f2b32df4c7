"""Speed of the stream and accuracy of its causal poses: ``python -m benchmarks.live --data FOLDER``."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.inputs import open_prior, open_shot
from benchmarks.markdown import table
from benchmarks.plan import FULL, STUDIO
from benchmarks.run import HERE, machine
from benchmarks.usage import resident_mb
from factorsfm import Frame, FrameUpdate, MaskFolder, Stream, open_source
from factorsfm.evaluation.metrics import auc, trajectory_errors
from factorsfm.evaluation.truth import Shot
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot

Array = NDArray[np.float64]

_COLUMNS = (("ATE", 0.002), ("ATE", 0.02), ("T-RPE", 0.001), ("T-RPE", 0.005), ("R-RPE", 0.02), ("R-RPE", 0.1))
_HEADER = ["ATE 0.2 cm", "ATE 2 cm", "T-RPE 0.1 cm", "T-RPE 0.5 cm", "R-RPE 0.02°", "R-RPE 0.1°"]
_WARM_UP_FRAMES = 500  # of the long stream, after which memory is measured
SIGMAS = 5.0  # standard deviations within which a pose must be


@dataclass(frozen=True, slots=True)
class Measured:
    """A stream over one shot.

    Attributes:
        latency: (n,) seconds of each push.
        seconds: wall time of the whole stream, with decoding.
        errors: ATE, T-RPE and R-RPE of all frames, for each kind of poses.
        inside: (n - 1,) whether the truth is in the 5-sigma region of the causal pose.
        extent: largest distance of a true camera from the first one, metres.
    """

    name: str
    latency: Array
    seconds: float
    errors: dict[str, tuple[Array, Array, Array]]
    inside: NDArray[np.bool_]
    extent: float


def measure(shot: Shot, data: Path, models: Path, cache: Path) -> Measured:
    """Stream a shot with TCMonoDepth, then polish it."""
    depth = open_prior("tcmonodepth", shot, data, models, cache)
    masks = MaskFolder(shot.masks) if shot.masks is not None else None
    updates: list[FrameUpdate] = []
    latency = []
    with Stream(shot.camera, depth=depth, masks=masks) as stream:
        begin = time.perf_counter()
        with open_source(shot.frames()) as source:
            for frame in source:
                start = time.perf_counter()
                updates.append(stream.push(frame))
                latency.append(time.perf_counter() - start)
        seconds = time.perf_counter() - begin
        poses = {
            "as given": [update.cam_from_world for update in updates],
            "graph": stream.trajectory(),
            "polished": [frame.cam_from_world for frame in stream.finish().frames],
        }
    errors = {}
    for name, trajectory in poses.items():
        e = trajectory_errors(*pose_arrays(trajectory), shot.rotations, shot.centers)
        errors[name] = e.ate, e.t_rpe, e.r_rpe
    extent = float(np.linalg.norm(shot.centers - shot.centers[0], axis=1).max())
    return Measured(shot.name, np.array(latency), seconds, errors, _inside(updates, shot), extent)


def _inside(updates: Sequence[FrameUpdate], shot: Shot) -> NDArray[np.bool_]:
    poses, covariances = zip(*((update.cam_from_world, update.covariance) for update in updates), strict=True)
    return sigmas(poses, covariances, shot.rotations, shot.centers)[1:] < SIGMAS


def sigmas(
    poses: Sequence[pycolmap.Rigid3d | None], covariances: Sequence[Array | None], rotations: Array, centers: Array
) -> Array:
    """Errors of poses in standard deviations (Mahalanobis distance): the larger of rotation and translation.

    Poses are compared relative to the first one, after alignment of their scale.

    Args:
        poses, covariances: n each, None if there is none; the first pose must be there.
        rotations, centers: (n, 3, 3) world_from_cam and (n, 3), the truth.

    Returns:
        (n,), NaN without a pose or covariance; 0 for the first one.
    """
    found_rotations, found_centers = relative_poses(*pose_arrays(poses))
    rotations, centers = relative_poses(rotations, centers)
    settled = slice(len(centers) // 3, None)
    valid = np.isfinite(found_centers[settled, 0])
    true = centers[settled][valid]
    scale = np.sum(found_centers[settled][valid] * true) / np.sum(true**2)
    found = np.full(len(poses), np.nan)
    found[0] = 0.0
    for k, covariance in list(enumerate(covariances))[1:]:
        if covariance is None or not np.isfinite(found_centers[k, 0]):
            continue
        turn = cv2.Rodrigues(found_rotations[k].T @ rotations[k])[0].ravel()
        move = found_rotations[k].T @ (scale * centers[k] - found_centers[k])
        parts = ((turn, covariance[:3, :3]), (move, covariance[3:, 3:]))
        found[k] = max(_mahalanobis(error, c) for error, c in parts)
    return found


def _mahalanobis(error: Array, covariance: Array) -> float:
    if not covariance.any():  # the world itself: the first frame, and what repeats it
        return float(np.inf) if error.any() else 0.0
    return float(np.sqrt(error @ np.linalg.solve(covariance, error)))


def relative_poses(rotations: Array, centers: Array) -> tuple[Array, Array]:
    """Rotations and centres in the frame of the first camera."""
    return np.einsum("ji,njk->nik", rotations[0], rotations), (centers - centers[0]) @ rotations[0]


def speed_table(runs: Sequence[Measured]) -> str:
    """Frames per second and quantiles of the latency, by shot."""
    rows: list[list[object]] = []
    for run in runs:
        quantiles = [f"{1e3 * np.quantile(run.latency, q):.0f}" for q in (0.5, 0.95, 0.99)]
        rows.append([run.name, f"{len(run.latency) / run.seconds:.1f}", *quantiles])
    pooled = np.concatenate([run.latency for run in runs])
    total = sum(run.seconds for run in runs)
    quantiles = [f"{1e3 * np.quantile(pooled, q):.0f}" for q in (0.5, 0.95, 0.99)]
    rows.append(["all", f"{len(pooled) / total:.1f}", *quantiles])
    return table(["shot", "frames per second", "push, median ms", "95 %", "99 %"], rows)


def accuracy_table(runs: Sequence[Measured]) -> str:
    """The paper's AUC columns, by kind of poses, pooled over all frames."""
    rows: list[list[object]] = []
    for name in runs[0].errors:
        pooled = dict(
            zip(
                ("ATE", "T-RPE", "R-RPE"),
                map(np.concatenate, zip(*(r.errors[name] for r in runs), strict=True)),
                strict=True,
            )
        )
        rows.append([name, *(f"{auc(pooled[kind], threshold):.1f}" for kind, threshold in _COLUMNS)])
    return table(["poses", *_HEADER], rows)


def shot_table(runs: Sequence[Measured]) -> str:
    """Median ATE by kind of poses, and how often the truth is in the 5-sigma region, by shot."""
    rows: list[list[object]] = []
    for run in runs:
        ate = {name: float(np.median(errors[0])) for name, errors in run.errors.items()}
        rows.append(
            [
                run.name,
                *(f"{1e3 * value:.2f}" for value in ate.values()),
                f"{100.0 * ate['as given'] / run.extent:.2f}",
                f"{ate['graph'] / ate['polished']:.2f}",
                f"{100.0 * run.inside.mean():.1f}",
            ]
        )
    header = ["shot", *(f"median ATE {name}, mm" for name in runs[0].errors)]
    return table([*header, "as given, % of the path", "graph / polished", "truth in 5 sigma, %"], rows)


def long_stream(count: int) -> str:
    """Table of a rendered camera that moves back and forth for `count` frames: cost per frame, memory and drift.

    After the last frame the view is lost, and the first frame comes again.
    """
    shot = render_shot("truck", 60, 960, 540)
    latency: list[float] = []
    memory: dict[int, float] = {}
    updates = []
    with Stream(shot.camera) as stream:
        for k, frame in enumerate(islice(_back_and_forth(shot), count)):
            start = time.perf_counter()
            updates.append(stream.push(frame))
            latency.append(time.perf_counter() - start)
            if k in (_WARM_UP_FRAMES, count // 2, count - 1):
                memory[k] = resident_mb()
        with tempfile.NamedTemporaryFile() as file:
            stream.save(file.name)
            snapshot_mb = Path(file.name).stat().st_size / 1e6
        blank = np.zeros_like(shot.images[0])
        stream.push(Frame(count, blank, "blank"))
        again = stream.push(Frame(count + 1, shot.images[0], "again"))
    early, late = np.mean(latency[200:700]), np.mean(latency[-500:])  # seconds
    order = [k for k, _ in zip(_turns(len(shot.images)), range(count), strict=False)]
    truth = [shot.cam_from_world[k] for k in order]
    errors = trajectory_errors(*pose_arrays([update.cam_from_world for update in updates]), *pose_arrays(truth))
    path = float(np.linalg.norm(np.ptp(pose_arrays(truth)[1], axis=0)))
    halves = np.nanmedian(errors.ate[200:700]), np.nanmedian(errors.ate[-500:])
    rows: list[list[object]] = [
        ["frames", count],
        ["registered", sum(update.cam_from_world is not None for update in updates)],
        ["ms per frame, frames 200 to 700", f"{1e3 * early:.1f}"],
        ["ms per frame, the last 500", f"{1e3 * late:.1f}"],
        ["ratio", f"{late / early:.2f}"],
        [f"resident memory after frame {_WARM_UP_FRAMES}, MB", f"{memory[_WARM_UP_FRAMES]:.0f}"],
        ["resident memory half way, MB", f"{memory[count // 2]:.0f}"],
        ["resident memory at the end, MB", f"{memory[count - 1]:.0f}"],
        ["snapshot at the end, MB", f"{snapshot_mb:.0f}"],
        ["the first view after a gap", again.message],
        ["median ATE of frames 200 to 700, % of the path", f"{100 * halves[0] / path:.3f}"],
        ["median ATE of the last 500 frames, % of the path", f"{100 * halves[1] / path:.3f}"],
    ]
    return table(["a move back and forth", ""], rows)


def _turns(frames: int) -> Iterator[int]:
    while True:
        yield from range(frames)
        yield from range(frames - 2, 0, -1)


def _back_and_forth(shot: RenderedShot) -> Iterator[Frame]:
    for number, k in enumerate(_turns(len(shot.images))):
        yield Frame(number, shot.images[k], f"{number:06d}")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--models", type=Path, help="folder of the networks (default: models beside the data)")
    parser.add_argument("--shots", nargs="+", default=STUDIO, metavar="NAME", help="only these")
    parser.add_argument("--long", type=int, default=3000, metavar="FRAMES", help="length of the long stream, 0: none")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of LIVE.md")
    arguments = parser.parse_args()
    models = arguments.models or arguments.data.parent / "models"
    load = os.getloadavg()[0]
    runs = []
    for name in arguments.shots:
        runs.append(measure(open_shot(arguments.data, name, FULL), arguments.data, models, HERE / "cache"))
        print(shot_table(runs[-1:]), speed_table(runs[-1:]), sep="\n", flush=True)
    parts = [
        "# Live",
        f"Generated by `python -m benchmarks.live`. Machine: {machine()}; load at the start {load:.1f}.",
        "TCMonoDepth at the keyframes, known lens; decoding, masks, tracking, network and graph included.",
        "## Speed",
        speed_table(runs),
        "## Accuracy",
        "Area under the recall curve in percent, pooled over all frames: of the poses as given at each frame, of those "
        "of the graph at the last frame, and of the polished ones.",
        accuracy_table(runs),
        shot_table(runs),
    ]
    if arguments.long:
        parts += ["## A long stream", long_stream(arguments.long)]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "LIVE.md").write_text("\n\n".join(parts) + "\n")
    latency = {run.name: run.latency.tolist() for run in runs}
    (arguments.output / "live.json").write_text(json.dumps({"latency": latency}))
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
