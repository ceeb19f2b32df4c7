"""Measures one cell in a process of its own: ``python -m benchmarks.cell < job.json``.

The job names the cell, the folders `data`, `models` and `cache`, and the file to write, `record`.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import VARIANTS, open_frames, open_prior, open_shot, settle
from benchmarks.plan import AS_SET, COLMAP, UNORDERED, Cell
from benchmarks.store import Record, cell_key, record_path, save
from benchmarks.usage import cpu_seconds, peak_mb
from factorsfm import MaskFolder, Options, Reconstruction, Stream
from factorsfm.evaluation import baselines
from factorsfm.evaluation.metrics import DepthErrors, parallax, point_depth_errors, trajectory_errors
from factorsfm.evaluation.truth import Shot
from factorsfm.imagesets.image_set import ImageSet
from factorsfm.support.similarity import pose_arrays

Array = NDArray[np.float64]

_MOST_DEPTHS = 10_000  # depths of observed points that are kept, a random sample; enough to compute shares
CODE_CHANGED = 3  # exit status: the job was written by other code than that of this process


@dataclass(frozen=True, slots=True)
class Folders:
    """The folders of a run.

    Attributes:
        data: the sets.
        models: the networks.
        cache: the records, and simulated priors and matches that several cells share.
    """

    data: Path
    models: Path
    cache: Path


@dataclass(frozen=True, slots=True)
class Estimate:
    """The result of a method: poses as in `evaluation.metrics`, and the observations of its points.

    Attributes:
        indices: (n,) of the frames.
        rotations: (n, 3, 3) world_from_cam.
        centers: (n, 3) camera centres.
        frame: (m,) row in `indices` of each observation.
        xy: (m, 2) pixels.
        depth: (m,) z-depth of the point in that camera.
        facts: see `Record.facts`.
        given: rotations and centres of the causal poses; None if the method has none.
    """

    indices: NDArray[np.int64]
    rotations: Array
    centers: Array
    frame: NDArray[np.int64]
    xy: Array
    depth: Array
    facts: dict[str, Any]
    given: tuple[Array, Array] | None = None


def measure(cell: Cell, folders: Folders) -> Record:
    """Run the method of a cell and compare its result with the truth; an exception becomes a record with the reason."""
    load = os.getloadavg()[0]
    shot = open_shot(folders.data, cell.shot, cell.variant)
    try:
        estimate = (_baseline if cell.method in COLMAP else _factorsfm)(cell, shot, folders)
    except Exception as error:
        traceback.print_exc()
        return unregistered(cell, shot, f"{type(error).__name__}: {error}")
    record = judge(cell, shot, estimate)
    record.facts.setdefault("cpu_seconds", cpu_seconds())
    record.facts["peak_mb"] = max(peak_mb(), record.facts.get("peak_mb", 0.0))
    record.facts["load"] = load
    return record


def judge(cell: Cell, shot: Shot, estimate: Estimate) -> Record:
    """The record of an estimate and the truth; frames without an estimated pose are NaN."""
    n = len(shot.indices)
    rotations, centers = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    _, rows, found = np.intersect1d(shot.indices, estimate.indices, return_indices=True)
    rotations[rows], centers[rows] = estimate.rotations[found], estimate.centers[found]
    alignment = trajectory_errors(rotations, centers, shot.rotations, shot.centers).alignment
    parts = []
    for row, index in enumerate(estimate.indices):
        truth = shot.depth(int(index)) if alignment is not None else None
        if truth is None or alignment is None:
            continue
        seen = estimate.frame == row
        size = (shot.camera.width, shot.camera.height)
        parts.append(point_depth_errors(estimate.xy[seen], estimate.depth[seen], truth, size, alignment.scale))
    depths = DepthErrors.pool(parts)
    known = np.flatnonzero(np.isfinite(depths.truth))
    if len(known) > _MOST_DEPTHS:
        known = np.sort(np.random.default_rng(0).choice(known, _MOST_DEPTHS, replace=False))
    record = _record(cell, shot, rotations, centers, estimate.facts, depths.estimate[known], depths.truth[known])
    if estimate.given is not None:
        record.arrays["given_rotations"], record.arrays["given_centers"] = estimate.given
    return record


def unregistered(cell: Cell, shot: Shot, reason: str) -> Record:
    """The record of a method that failed, without registered frames."""
    n = len(shot.indices)
    facts = {"failed": reason, "seconds": {}}
    return _record(cell, shot, np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan), facts, np.empty(0), np.empty(0))


def _record(
    cell: Cell, shot: Shot, rotations: Array, centers: Array, facts: dict[str, Any], depth: Array, true_depth: Array
) -> Record:
    arrays: dict[str, NDArray[Any]] = {
        "indices": shot.indices,
        "rotations": rotations,
        "centers": centers,
        "true_rotations": shot.rotations,
        "true_centers": shot.centers,
        "depth": depth.astype(np.float32),
        "true_depth": true_depth.astype(np.float32),
    }
    return Record(cell, {"failed": None, "parallax": true_parallax(shot), **facts}, arrays)


def true_parallax(shot: Shot) -> float | None:
    """The paper's parallax, from the true path and the true depth maps; None if there are no maps."""
    maps = [depth[::4, ::4].ravel() for i in shot.indices if (depth := shot.depth(int(i))) is not None]
    return parallax(shot.centers, np.concatenate(maps)) if maps else None


def _factorsfm(cell: Cell, shot: Shot, folders: Folders) -> Estimate:
    """Our method, timed from the open source to the written result."""
    options = Options.preset_named(cell.method)
    if (tracks := VARIANTS[cell.variant].max_tracks) is not None:
        options = replace(options, tracker=replace(options.tracker, max_tracks=tracks))
    frames = open_frames(shot, cell.variant)
    begin = time.perf_counter()
    masks = MaskFolder(shot.masks) if shot.masks is not None else None
    depth = open_prior(cell.prior, shot, folders.data, folders.models, folders.cache)
    if cell.shot in UNORDERED or cell.variant == AS_SET:
        with tempfile.TemporaryDirectory(prefix="matches-") as folder:
            images = ImageSet(Path(folder), shot.camera, depth=depth, masks=masks, options=options)
            for frame in frames:
                images.add(frame)
            result, given = images.finish(), None
    else:
        with Stream(shot.camera, depth=depth, masks=masks, options=options) as stream:
            given = pose_arrays([stream.push(frame).cam_from_world for frame in frames])
            result = stream.finish()
    with tempfile.TemporaryDirectory(prefix="result-") as folder:
        start = time.perf_counter()
        result.write(Path(folder) / "result")
        end = time.perf_counter()
    seconds = {**result.seconds, "writing": end - start}
    seconds["reading and rest"] = end - begin - sum(seconds.values())
    return _estimate(result, {**seconds, "total": end - begin}, given)


def _estimate(result: Reconstruction, seconds: Mapping[str, float], given: tuple[Array, Array] | None) -> Estimate:
    rotations, centers = pose_arrays([frame.cam_from_world for frame in result.frames])
    rays = result.points[result.observation_point] - centers[result.observation_frame]
    return Estimate(
        indices=np.array([frame.index for frame in result.frames]),
        rotations=rotations,
        centers=centers,
        frame=result.observation_frame,
        xy=result.observation_xy,
        depth=np.einsum("ni,ni->n", rays, rotations[result.observation_frame, :, 2]),
        facts={
            "seconds": dict(seconds),
            "kind": str(result.kind),
            "notes": result.notes,
            "points": len(result.points),
        },
        given=given,
    )


def _baseline(cell: Cell, shot: Shot, folders: Folders) -> Estimate:
    """A mapper of COLMAP, on the matches that all its mappers share."""
    matches, matching = _matches(cell, shot, folders)
    before = cpu_seconds()
    result = getattr(baselines, cell.method)(matches)
    return Estimate(
        result.indices,
        result.rotations,
        result.centers,
        result.observation_frame,
        result.observation_xy,
        result.observation_depth,
        facts={
            "seconds": {**result.seconds, "total": sum(result.seconds.values())},
            "cpu_seconds": matching["cpu_seconds"] + cpu_seconds() - before,
            "peak_mb": matching["peak_mb"],
            "settings": result.settings,
            "points": len(result.points),
        },
    )


def matches_folder(cell: Cell, folders: Folders) -> Path:
    """The folder of the matches of a shot for all mappers of COLMAP.

    The runner deletes it after the last mapper, with folders beside it that interrupted attempts have left.
    """
    anchor = replace(cell, method=COLMAP[0])
    return folders.cache / "matches" / f"{cell.shot}.{cell.variant}.{cell_key(anchor, folders.data)}"


def _matches(cell: Cell, shot: Shot, folders: Folders) -> tuple[baselines.Matches, dict[str, float]]:
    """The shared matches, and the CPU seconds and the peak memory that they took."""
    folder = matches_folder(cell, folders)
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f"{folder.name}.unfinished-", dir=folder.parent))
        try:
            made = baselines.match_frames(shot, open_frames(shot, cell.variant), scratch)
            facts = {
                "indices": made.indices.tolist(),
                "seconds": dict(made.seconds),
                "cost": {"cpu_seconds": cpu_seconds(), "peak_mb": peak_mb()},
            }
            (scratch / "matches.json").write_text(json.dumps(facts))
            settle(scratch, folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    facts = json.loads((folder / "matches.json").read_text())
    return baselines.Matches(folder, np.array(facts["indices"]), facts["seconds"]), facts["cost"]


def main() -> None:
    job = json.load(sys.stdin)
    folders = Folders(Path(job["data"]), Path(job["models"]), Path(job["cache"]))
    cell = Cell(**job["cell"])
    if record_path(cell, folders.data, folders.cache) != Path(job["record"]):
        sys.exit(CODE_CHANGED)
    save(Path(job["record"]), measure(cell, folders))


if __name__ == "__main__":
    main()
