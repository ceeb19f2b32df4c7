"""Whether a change of the code leaves the results as they are.

    python -m benchmarks.same_poses record BEFORE --data DATA --models MODELS     # with the code before the change
    python -m benchmarks.same_poses compare BEFORE --data DATA --models MODELS    # with the code after it

Each job is solved in a process of its own. Causal poses, polished poses, covariances, points and the focal length are
compared bit by bit; if they differ, the largest displacement of a camera is given as a share of the path.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import zlib  # noqa: F401  as in `factorsfm`: before pycolmap
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import NETWORK_FILES, shot_folder

Array = NDArray[np.float64]
Arrays = dict[str, Array]

ALLOWED = 1e-6  # largest displacement as a share of the path, for changes that reorder arithmetic
_WORKERS = 2


@dataclass(frozen=True, slots=True)
class Job:
    """A set, solved in one way.

    Attributes:
        shot: name of the set.
        camera, masks: whether those of the set are given.
        live: whether the frames are pushed one by one, so that the causal poses are compared, too.
        options: further arguments of `factorsfm.reconstruct`.
    """

    shot: str
    camera: bool = True
    masks: bool = False
    live: bool = False
    options: tuple[tuple[str, Any], ...] = ()


JOBS = {
    "dolly": Job("d01_livingroom_dolly_in", live=True),
    "truck": Job("d02_livingroom_truck_actor", masks=True, live=True),
    "handheld": Job("d03_livingroom_handheld", live=True),
    "arc": Job("d05_warehouse_walk_arc", live=True),
    "set": Job("fountain-P11", options=(("unordered", True),)),
    "unknown lens": Job("d04_warehouse_crane", camera=False, options=(("frames", slice(0, 40)),)),
    "rolling shutter": Job("kitchen-000", options=(("shutter", "rolling"),)),
    "paper": Job("d08_arena_pedestal", options=(("preset", "paper"), ("frames", slice(0, 40)))),
    "set, unknown lens": Job("herzjesu-P8", camera=False, options=(("unordered", True),)),
}


def solve(job: Job, data: Path, models: Path, work: Path) -> Arrays:
    """The result of a job as arrays.

    Args:
        work: folder for the matches of a set, which differ a little from run to run.
    """
    import factorsfm
    from factorsfm import MaskFolder, Stream

    folder = shot_folder(data, job.shot)
    source = folder / "shot.mp4" if (folder / "shot.mp4").exists() else folder / "images"
    depth = models / NETWORK_FILES["tcmonodepth"]
    camera = folder / "camera.json" if job.camera else None
    masks = folder / "masks" if job.masks else None
    given: list[Any] = []
    if job.live:
        prior, ignored = factorsfm.DepthModel(depth), MaskFolder(masks) if masks else None
        with Stream(factorsfm.read_camera(camera), depth=prior, masks=ignored) as stream:
            given = [stream.push(frame) for frame in factorsfm.read_frames(source)]
            result = stream.finish()
    else:
        result = factorsfm.reconstruct(source, camera=camera, depth=depth, masks=masks, work=work, **dict(job.options))
    return {
        "poses": _matrices([frame.cam_from_world for frame in result.frames]),
        "poses as given": _matrices([update.cam_from_world for update in given]),
        "covariances": _stacked([f.covariance for f in result.frames]),
        "points": result.points,
        "focal length": np.array([result.camera.mean_focal_length()]),
    }


def _matrices(poses: Sequence[Any]) -> Array:
    """(n, 3, 4) cam_from_world, NaN without a pose."""
    return np.array([np.full((3, 4), np.nan) if pose is None else pose.matrix() for pose in poses]).reshape(-1, 3, 4)


def _stacked(covariances: Sequence[Array | None]) -> Array:
    return np.array([np.full((6, 6), np.nan) if c is None else c for c in covariances]).reshape(-1, 6, 6)


def difference(before: Arrays, after: Arrays) -> tuple[float, list[str]]:
    """The largest displacement of a camera as a share of the path, and the names of the arrays that differ."""
    changed = [name for name, old in before.items() if not np.array_equal(old, after[name], equal_nan=True)]
    worst = 0.0
    for name in ("poses", "poses as given"):
        old, new = (_centers(arrays[name]) for arrays in (before, after))
        if old.shape != new.shape or not np.array_equal(np.isnan(old), np.isnan(new)):
            return float("inf"), changed
        seen = np.isfinite(old[:, 0])
        if seen.any():
            path = np.linalg.norm(np.diff(old[seen], axis=0), axis=1).sum()
            worst = max(worst, float(np.linalg.norm(old - new, axis=1)[seen].max() / max(path, 1e-9)))
    return worst, changed


def _centers(poses: Array) -> Array:
    return np.asarray(-np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]))


def _run_all(names: Sequence[str], folder: Path, arguments: Sequence[str]) -> None:
    """Solve jobs in processes of their own, two at a time; each writes its arrays to the folder."""

    def run(name: str) -> None:
        command = [sys.executable, "-m", "benchmarks.same_poses", "solve", str(folder), "--jobs", name, *arguments]
        subprocess.run(command, check=True)

    with ThreadPoolExecutor(_WORKERS) as pool:
        list(pool.map(run, names))


def _compare(names: Sequence[str], before: Path, arguments: Sequence[str]) -> bool:
    """Solve the jobs again and print how far each is from its record; returns whether all are within `ALLOWED`."""
    good = True
    with tempfile.TemporaryDirectory() as folder:
        _run_all(names, Path(folder), [*arguments, "--matches", str(before / "matches")])
        for name in names:
            old, new = (dict(np.load(place / f"{name}.npz")) for place in (before, Path(folder)))
            worst, changed = difference(old, new)
            said = "the same to the bit" if not changed else f"{worst:.1e} of the path; changed: {', '.join(changed)}"
            print(f"{name:20}{said}")
            good &= worst <= ALLOWED
    return good


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("action", choices=["record", "compare", "solve"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--matches", type=Path, help="where the matches of sets lie; by default in the folder")
    parser.add_argument("--jobs", nargs="+", choices=list(JOBS), default=list(JOBS))
    arguments = parser.parse_args()
    rest = ["--data", str(arguments.data), "--models", str(arguments.models)]
    arguments.folder.mkdir(parents=True, exist_ok=True)
    arguments.matches = arguments.matches or arguments.folder / "matches"
    actions: dict[str, Callable[[], bool]] = {
        "record": lambda: _run_all(arguments.jobs, arguments.folder, rest) is None,
        "compare": lambda: _compare(arguments.jobs, arguments.folder, rest),
        "solve": lambda: _solve_here(
            arguments.jobs, arguments.folder, arguments.matches, arguments.data, arguments.models
        ),
    }
    sys.exit(0 if actions[arguments.action]() else 1)


def _solve_here(names: Sequence[str], folder: Path, matches: Path, data: Path, models: Path) -> bool:
    for name in names:
        np.savez(folder / f"{name}.npz", **solve(JOBS[name], data, models, matches / name))
    return True


if __name__ == "__main__":
    main()
