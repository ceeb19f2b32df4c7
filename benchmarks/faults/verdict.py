"""What is wrong with the poses of a run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from benchmarks.faults.plan import Plan
from benchmarks.live import SIGMAS, sigmas
from factorsfm import FrameUpdate, Reconstruction
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.support.similarity import pose_arrays

_LEAST_POSES = 8  # with fewer, the free scale cannot be told from errors
WRONG_SHARE = 0.25  # median error of a polished path over its extent, above which it is wrong
WRONG_DEG = 2.0  # median rotation error from frame to frame, above which it is wrong


def wrong_result(result: Reconstruction, plan: Plan) -> list[str]:
    """The errors of a polished path that are too large, in sentences."""
    posed = [(frame.index, frame.cam_from_world) for frame in result.frames if frame.cam_from_world is not None]
    main, faults = _foreign_poses(posed, plan)
    known = [(plan.frames[k].origin, pose) for k, pose in posed if _origin_shot(plan, k) == main]
    if len(known) < _LEAST_POSES:
        return faults
    shot, order = plan.shots[main], [origin[1] for origin, _ in known if origin is not None]
    errors = trajectory_errors(*pose_arrays([p for _, p in known]), shot.rotations[order], shot.centers[order])
    extent = float(np.linalg.norm(np.ptp(shot.centers[order], axis=0)))
    share, rotation_deg = float(np.nanmedian(errors.ate)) / extent, float(np.nanmedian(errors.r_rpe))
    if share > WRONG_SHARE or rotation_deg > WRONG_DEG:
        faults.append(f"the polished path is off by {100 * share:.0f} % of its extent, {rotation_deg:.2f} degrees")
    return faults


def wrong_updates(log: Path, plan: Plan) -> list[str]:
    """The causal poses that are wrong, in sentences; a stream that starts anew makes the poses before void."""
    updates = {line["index"]: line for line in _lines(log) if "index" in line}
    faults: list[str] = []
    for number in sorted({line["shot"] for line in updates.values()}):
        lines = [updates[k] for k in sorted(updates) if updates[k]["shot"] == number]
        begin = max((row for row, line in enumerate(lines) if line["starts_anew"]), default=0)
        lines = [line for line in lines[begin:] if line["pose"] is not None]
        posed = [(line["index"], pycolmap.Rigid3d(np.array(line["pose"]))) for line in lines]
        main, foreign = _foreign_poses(posed, plan)
        faults += foreign
        rows = [row for row, (k, _) in enumerate(posed) if _origin_shot(plan, k) == main]
        if len(rows) < _LEAST_POSES:
            continue
        origins = [plan.frames[posed[row][0]].origin for row in rows]
        order = [origin[1] for origin in origins if origin is not None]
        covariances = [None if (c := lines[row]["covariance"]) is None else np.array(c) for row in rows]
        shot = plan.shots[main]
        errors = sigmas([posed[row][1] for row in rows], covariances, shot.rotations[order], shot.centers[order])
        faults += [
            f"frame {posed[row][0]} is off by {error:.1f} sigma"
            for row, error in zip(rows, errors, strict=True)
            if error > SIGMAS  # false for NaN, of a pose without covariance
        ]
    return faults


def update_line(update: FrameUpdate) -> str:
    """An update as a line of the log."""
    pose, covariance = update.cam_from_world, update.covariance
    content = {
        "index": update.index,
        "shot": update.shot,
        "status": update.status,
        "pose": pose.matrix().tolist() if pose is not None else None,
        "covariance": covariance.tolist() if covariance is not None else None,
        "starts_anew": update.starts_anew,
    }
    return json.dumps(content)


def last_saved(log: Path) -> int:
    """Number of frames in the last snapshot, 0 without one."""
    return max((line["saved"] for line in _lines(log) if "saved" in line), default=0)


def _lines(log: Path) -> Iterator[dict[str, Any]]:
    for line in log.read_text().splitlines():
        with suppress(json.JSONDecodeError):  # the line that was being written when the process was killed
            yield json.loads(line)


def _foreign_poses(posed: Sequence[tuple[int, Any]], plan: Plan) -> tuple[int, list[str]]:
    """The shot to which most of the posed frames belong, and a sentence for each of the others."""
    origins = [_origin_shot(plan, k) for k, _ in posed]
    counts = Counter(origin for origin in origins if origin >= 0)
    if not counts:  # in a film, noise may become a shot of its own
        return 0, []
    main = counts.most_common(1)[0][0]
    wrong = [k for (k, _), origin in zip(posed, origins, strict=True) if origin != main]
    return main, [f"frame {k} has a pose, but shows nothing of the shot" for k in wrong]


def _origin_shot(plan: Plan, index: int) -> int:
    """Position of the shot that a frame shows, -1 if it shows none."""
    origin = plan.frames[index].origin
    return -1 if origin is None else origin[0]
