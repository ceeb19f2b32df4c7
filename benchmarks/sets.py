"""Image sets: photographs and shuffled videos beside COLMAP, learned features, and a large rendered set.

    python -m benchmarks.sets --data FOLDER --models FOLDER [--images 200] [--work FOLDER]

The data folder is that of `benchmarks.inputs`. Every measurement runs in a process of its own and is kept in sets.json
beside the table, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import signal
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

import factorsfm
from benchmarks.inputs import NETWORK_FILES, shot_folder
from benchmarks.plan import KITCHEN, STUDIO, UNORDERED, WIDE_VIDEO
from benchmarks.usage import peak_mb
from factorsfm.evaluation.baselines import colmap_default, colmap_global, colmap_tuned, match_frames
from factorsfm.evaluation.metrics import auc, relative_pose_errors, trajectory_errors
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import Shot
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.priors.masks import MaskFolder
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_views, room_camera

RESULTS = Path(__file__).parent / "results"
VIDEOS = (STUDIO[0], STUDIO[3], *WIDE_VIDEO)  # besides the kitchen clips
FRAME_STEP = 3  # of videos
COLMAP = MappingProxyType({"COLMAP": colmap_default, "COLMAP tuned": colmap_tuned, "COLMAP global": colmap_global})
WIDTH, HEIGHT = 1600, 1066
ENOUGH_IMAGES = 40  # to measure how the cost of an image grows
_RENDERED_EXTENT = 2.0  # of the path through the rendered room, units

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Case:
    """One measurement.

    Attributes:
        name: of the set.
        method: "sift" or "xfeat" without a depth prior, "sift+prior" with one, or a key of `COLMAP`.
        known: whether the lens is given.
    """

    name: str
    method: str
    known: bool = True

    @property
    def key(self) -> str:
        """Its key in the file of results."""
        return f"{self.name} {self.method} {'known' if self.known else 'unknown'}"


def rendered_path(count: int) -> list[pycolmap.Rigid3d]:
    """cam_from_world of cameras on a closed path through the room, which pan to both sides on the way."""
    poses = []
    for t in 2 * np.pi * np.arange(count) / count:
        center = np.array([0.8 * np.sin(t), 0.35 * np.sin(5 * t), 0.5 + np.cos(t)])
        turn = np.array([0.0, np.radians(50) * np.sin(2 * t), 0.0])
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(turn), center).inverse())
    return poses


def measure(case: Case, data: Path, models: Path, work: Path) -> dict[str, dict[str, Any]]:
    """Run a case in this process.

    Returns:
        Errors, seconds by stage, CPU seconds, peak memory and cost by number of images, by method: a case of COLMAP
        runs all its mappers, which share the matches.
    """
    with tempfile.TemporaryDirectory() as temporary:
        if case.name.startswith("rendered"):
            poses = rendered_path(int(case.name.split("-")[1]))
            folder = work / case.name
            render(folder / "images", poses)
            turns, centers = pose_arrays(poses)
            outcomes = {"sift": _ours(folder / "images", room_camera(WIDTH, HEIGHT), "sift", folder / "work")}
        else:
            shot = read_shot(shot_folder(data, case.name))
            frames = list(shot.frames())
            if case.name not in UNORDERED:
                frames = [
                    frames[k] for k in np.random.default_rng(0).permutation(np.arange(0, len(frames), FRAME_STEP))
                ]
            turns, centers = shot.truth(np.array([frame.index for frame in frames]))
            if case.method in COLMAP:
                methods = [c.method for c in real_cases() if replace(c, method=case.method) == case]
                methods = [method for method in methods if method in COLMAP]
                outcomes = (_colmap if case.known else _colmap_unknown)(methods, shot, frames, Path(temporary))
            else:
                ours = _ours(
                    frames,
                    shot.camera if case.known else None,
                    models if case.method == "xfeat" else "sift",
                    Path(temporary),
                    depth=models / NETWORK_FILES["tcmonodepth"] if case.method == "sift+prior" else None,
                    masks=None if shot.masks is None else MaskFolder(shot.masks),
                )
                outcomes = {case.method: ours}
    return {
        method: asdict(replace(case, method=method)) | _judged(outcome, turns, centers)
        for method, outcome in outcomes.items()
    }


def _judged(outcome: dict[str, Any], turns: Array, centers: Array) -> dict[str, Any]:
    """The outcome, with the errors of its poses in place of the poses."""
    estimate = np.array(outcome.pop("turns")), np.array(outcome.pop("centers"))
    errors = trajectory_errors(*estimate, turns, centers)
    return outcome | {
        "images": len(turns),
        "registered": int(np.isfinite(estimate[1]).all(axis=1).sum()),
        "ate": float(np.sqrt(np.nanmean(errors.ate**2))),
        "auc": float(auc(relative_pose_errors(*estimate, turns, centers), 1.0)),
        "peak": peak_mb(),
    }


def render(folder: Path, poses: list[pycolmap.Rigid3d]) -> None:
    """Render the images that are not in the folder yet."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{k:04d}.png" for k in range(len(poses))]
    missing = [k for k, path in enumerate(paths) if not path.exists()]
    for k, image in zip(missing, render_views([poses[k] for k in missing], WIDTH, HEIGHT), strict=True):
        cv2.imwrite(str(paths[k]), image)


def _ours(
    source: Any, camera: pycolmap.Camera | None, features: Any, work: Path, depth: Any = None, masks: Any = None
) -> dict[str, Any]:
    trace: list[tuple[int, float]] = []
    accept = SetMapper._accept

    def traced(mapper: SetMapper, *arguments: Any) -> None:
        accept(mapper, *arguments)
        trace.append((mapper.registered, time.process_time()))

    matched = not any(work.glob("*.db"))
    begin, used = time.perf_counter(), time.process_time()
    with patch.object(SetMapper, "_accept", traced):
        result = factorsfm.reconstruct(
            source, camera=camera, depth=depth, masks=masks, unordered=True, features=features, work=work
        )
    turns, centers = pose_arrays([frame.cam_from_world for frame in result.frames])
    return {
        "turns": turns,
        "centers": centers,
        "seconds": {k: v for k, v in result.seconds.items() if v > 0.05 and k != "total"},
        "total": time.perf_counter() - begin,
        "cpu": time.process_time() - used,
        "matched": matched,
        "solving_cpu": time.process_time() - trace[0][1],
        "points": len(result.points),
        "trace": trace,
    }


def _colmap(methods: list[str], shot: Shot, frames: list[factorsfm.Frame], folder: Path) -> dict[str, dict[str, Any]]:
    """Mappers of COLMAP with the known lens held fixed."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    used = time.process_time()
    matches = match_frames(shot, frames, folder)
    matched, outcomes = time.process_time(), {}
    for method in methods:
        begin = time.process_time()
        found = COLMAP[method](matches)
        outcomes[method] = {
            "turns": found.rotations,
            "centers": found.centers,
            "seconds": dict(found.seconds),
            "total": sum(found.seconds.values()),
            "cpu": matched - used + time.process_time() - begin,
            "points": len(found.points),
        }
    return outcomes


def _colmap_unknown(
    methods: list[str], shot: Shot, frames: list[factorsfm.Frame], folder: Path
) -> dict[str, dict[str, Any]]:
    """Mappers of COLMAP with default options and an unknown lens, for which it guesses focal length and distortion."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    (folder / "images").mkdir()
    names = [f"{frame.index:06d}.png" for frame in frames]
    for frame, name in zip(frames, names, strict=True):
        cv2.imwrite(str(folder / "images" / name), frame.image)
    database, begin, used = folder / "database.db", time.perf_counter(), time.process_time()
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    matched, matched_cpu, outcomes = time.perf_counter(), time.process_time(), {}
    for method in methods:
        start, start_cpu = time.perf_counter(), time.process_time()
        mapping = pycolmap.global_mapping if "global" in method else pycolmap.incremental_mapping
        models = mapping(database, folder / "images", Path(tempfile.mkdtemp(dir=folder)))
        model = max(models.values(), key=lambda m: m.num_reg_images(), default=pycolmap.Reconstruction())
        by_name = {image.name: image for image in model.images.values() if image.has_pose}
        turns, centers = pose_arrays([by_name[n].cam_from_world() if n in by_name else None for n in names])
        seconds = {"matching": matched - begin, "mapping": time.perf_counter() - start}
        outcomes[method] = {
            "turns": turns,
            "centers": centers,
            "seconds": seconds,
            "total": sum(seconds.values()),
            "cpu": matched_cpu - used + time.process_time() - start_cpu,
            "points": model.num_points3D(),
        }
    return outcomes


# --- the tables -------------------------------------------------------------------------------------------------


def growth(trace: list[list[float]]) -> tuple[Array, Array, float]:
    """Registered images, CPU seconds of the mapper so far, and the exponent p with which the cost of an image grows.

    If the cost of one image grows with the power p of their number, the total grows with the power p + 1.
    """
    first = max(k for k, (count, _) in enumerate(trace) if count <= 1)  # earlier starts were given up
    images, seconds = np.array(trace[first:], np.float64).T
    seconds = seconds - seconds[0]
    late = images >= images[-1] / 4
    exponent = float(np.polyfit(np.log(images[late]), np.log(np.maximum(seconds[late], 1e-3)), 1)[0]) - 1.0
    return images, seconds, exponent


def draw(found: dict[str, Any], command: str) -> None:
    """Write SETS.md and its figure."""
    text = ["# Image sets", "", f"`{command}`", ""]
    text += [
        "Wall time, which depends on other work of the machine, and CPU time of all threads, from images to poses; "
        "ATE: root mean square after alignment; AUC: of the relative poses of all pairs. Videos (kitchen, d01, d04, "
        f"d09): every {FRAME_STEP}rd frame, in random order. COLMAP: its incremental mapper with default options, the "
        "same tuned for small parallax, and its global mapper (tuned if the lens is known), all with SIFT on the CPU "
        "as here; a known lens is held fixed.", "",
        "| set | lens | method | images | ATE mm | AUC at 1° | wall s | CPU s | of COLMAP's CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for case in real_cases():
        if case.key in found:
            r, other = found[case.key], found.get(replace(case, method="COLMAP").key)
            ratio = f"{r['cpu'] / other['cpu']:.2f}" if other else ""
            text.append(
                f"| {case.name} | {'known' if case.known else 'unknown'} | {case.method} "
                f"| {r['registered']}/{r['images']} | {_millimetres(r['ate'])} | {r['auc']:.1f} "
                f"| {r['total']:.0f} | {r['cpu']:.0f} | {ratio} |"
            )
    traced = {key: r for key, r in found.items() if key.startswith("rendered")}
    if traced:
        text += [
            "", f"A rendered room, {WIDTH}x{HEIGHT} pixels, known lens. ATE as a share of the extent of the path. CPU "
            "s: of the whole run, if it made the matches; solving: of mapper and polish.", "",
            "| images | registered | points | ATE | wall s | by stage | CPU s | solving | peak MB | cost of an image |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]  # fmt: skip
        for r in sorted(traced.values(), key=lambda r: r["images"]):
            stages = ", ".join(f"{name} {value:.0f}" for name, value in r["seconds"].items())
            share = r["ate"] / _RENDERED_EXTENT
            text.append(
                f"| {r['images']} | {r['registered']} | {r['points']:,} | {share:.1e} | {r['total']:.0f} "
                f"| {stages} | {_everything(r)} | {_solving(r)} | {r['peak']:.0f} | {_cost(r)} |"
            )
        if large := [r for r in traced.values() if r["images"] >= ENOUGH_IMAGES]:
            text += ["", "![Cost of an image against the registered images](sets_cost.png)"]
            _plot(large)
    (RESULTS / "SETS.md").write_text("\n".join(text) + "\n", encoding="utf-8")


def _millimetres(ate: float) -> str:
    return f"{1000 * ate:.2f}" if np.isfinite(ate) else "–"


def _everything(record: dict[str, Any]) -> str:
    """CPU seconds of the run, unless its matches are those of another run."""
    return f"{record['cpu']:.0f}" if record.get("matched", True) else "–"


def _solving(record: dict[str, Any]) -> str:
    return f"{record['solving_cpu']:.0f}" if "solving_cpu" in record else "–"


def _cost(record: dict[str, Any]) -> str:
    """How the cost of an image grows with the number n of registered ones, if there are enough."""
    return f"n^{growth(record['trace'])[2]:.2f}" if record["images"] >= ENOUGH_IMAGES else "–"


def _plot(records: list[dict[str, Any]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2))
    for r in sorted(records, key=lambda r: r["images"]):
        images, seconds, exponent = growth(r["trace"])
        window = max(2, len(images) // 10)
        cost = (seconds[window:] - seconds[:-window]) / (images[window:] - images[:-window])
        axes.plot(images[window:], cost, label=f"{r['images']} images: n^{exponent:.2f}")
    axes.set(xlabel="registered images", ylabel="CPU seconds of the mapper for one image", xlim=0, ylim=0)
    axes.legend()
    figure.tight_layout()
    figure.savefig(RESULTS / "sets_cost.png", dpi=130)
    plt.close(figure)


def real_cases() -> list[Case]:
    """The cases of photographs and videos."""
    lenses = (True, False)
    wide = [Case(n, m, known) for n in UNORDERED for known in lenses for m in ("COLMAP", "COLMAP global", "sift")]
    small = [
        Case(n, m, known)
        for n in KITCHEN
        for known in lenses
        for m in (*COLMAP, "sift", "sift+prior")
        if known or m != "COLMAP tuned"
    ]
    videos = [Case(n, m) for n in VIDEOS for m in (*COLMAP, "sift+prior")]
    return wide + small + videos + [Case(n, "xfeat") for n in (*UNORDERED, *KITCHEN)]


def main() -> None:
    """Measure the cases that have no result yet, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--images", type=int, nargs="*", default=[40, 200], help="sizes of the rendered set")
    parser.add_argument("--work", type=Path, help="keep the rendered images, features and matches here")
    parser.add_argument("--again", nargs="*", default=[], help="measure cases again whose key contains one of these")
    parser.add_argument("--only", default="", help="only cases whose key contains this")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that no measurement outlives the run
    stored = RESULTS / "sets.json"
    found = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
    command = f"python -m benchmarks.sets --data FOLDER --models FOLDER --images {' '.join(map(str, arguments.images))}"
    with tempfile.TemporaryDirectory() as temporary:
        work, measured = arguments.work or Path(temporary), set[str]()
        for case in [*real_cases(), *(Case(f"rendered-{n}", "sift") for n in arguments.images)]:
            again = any(word in case.key for word in arguments.again) and case.key not in measured
            if arguments.only not in case.key or (case.key in found and not again):
                continue
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                outcomes = pool.apply(measure, (case, arguments.data, arguments.models, work))
                pool.close()
                pool.join()
            for method, outcome in outcomes.items():
                measured.add(key := replace(case, method=method).key)
                found[key] = outcome
                print({key: value for key, value in outcome.items() if key != "trace"}, flush=True)
            stored.write_text(json.dumps(found) + "\n", encoding="utf-8")
    draw(found, command)


if __name__ == "__main__":
    main()
