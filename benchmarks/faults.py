"""What trouble does to a stream: ``python -m benchmarks.faults [--runs 200]``.

Every run follows a shot whose frames or priors are disturbed at random, in a process of its own that may also be killed
and started again. It must end in time, with a result or a clear reason, and give no wrong pose with a small covariance.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.inputs import open_prior, open_shot
from benchmarks.live import SIGMAS, sigmas
from benchmarks.markdown import table
from benchmarks.plan import FULL, STUDIO
from benchmarks.run import HERE, machine
from factorsfm import (
    DepthKind,
    DepthMap,
    Episode,
    Frame,
    FrameUpdate,
    InputError,
    Options,
    Reconstruction,
    ReconstructionError,
    Stream,
)
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_shot, simulate_prior

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Generator = np.random.Generator

DROPPED, DUPLICATED, BLACK, NOISE, DAMAGED, WRONG_SIZE, FOREIGN, CUT, NAN_DEPTH, RAISES, KILLED = KINDS = (
    "dropped frames", "duplicated frames", "black frames", "noise instead of frames", "damaged frames",
    "frame of another size", "stretch of another shot", "cut to another shot", "depth of NaN", "network that raises",
    "SIGKILL and resume",
)  # fmt: skip
_FRAMES = 40
_WIDTH, _HEIGHT = 320, 180
_LEAST_POSES = 8  # with fewer, the scale that is free cannot be told from errors
_WRONG_SHARE, _WRONG_DEG = 0.25, 2.0  # of a polished path: median error, share of its extent and degrees


@dataclass(frozen=True, slots=True)
class Material:
    """A shot with truth and prior; rotations and centers are world_from_cam."""

    images: list[Image]
    depth: Sequence[NDArray[np.float32] | None]
    camera: pycolmap.Camera
    rotations: Array
    centers: Array


@dataclass(frozen=True, slots=True)
class Item:
    """What is pushed: an image, and where it comes from (shot 0 or 1, frame), None where it is no view of anything."""

    image: Image
    origin: tuple[int, int] | None
    depth: str = ""  # "nan" or "raise"


@dataclass(slots=True)
class Plan:
    """A run.

    Attributes:
        kill: item at which the process is killed, None for never; delay: seconds after it.
        snapshot_every: frames. film: whether shots are told apart.
    """

    kinds: list[str]
    shots: list[Material]
    items: list[Item]
    kill: int | None = None
    delay: float = 0.0
    snapshot_every: int = 5
    film: bool = False


@dataclass(slots=True)
class Outcome:
    """How a run ended; `faults` are the sentences that must not be."""

    kinds: list[str]
    end: str = ""
    faults: list[str] = field(default_factory=list)


def plan(seed: int, data: Path | None) -> Plan:
    """One to three kinds of trouble."""
    generator = np.random.default_rng(seed)
    kinds = list(generator.choice(KINDS, generator.integers(1, 4), replace=False))
    shots = [_from_data(data, generator) if data else _rendered(generator)]
    if {FOREIGN, CUT} & set(kinds):
        shots.append(_rendered(generator, shots[0].images[0].shape, frames=20))
    made = Plan(kinds, shots, [Item(image, (0, k)) for k, image in enumerate(shots[0].images)])
    for kind in kinds:
        made.items = _disturbed(kind, made.items, shots, generator)
    if KILLED in kinds:
        made.kill = int(generator.integers(1, len(made.items)))
        made.delay = float(generator.uniform(0.0, 0.05))
        made.snapshot_every = int(generator.integers(1, 8))
    made.film = KILLED not in kinds and bool(generator.random() < 0.5)
    return made


def _rendered(generator: Generator, shape: tuple[int, ...] = (_HEIGHT, _WIDTH), frames: int = _FRAMES) -> Material:
    motion = generator.choice(["dolly", "truck", "handheld", "arc"])
    parallax, seed = generator.uniform(0.04, 0.15), int(generator.integers(1000))
    shot = render_shot(motion, frames, _WIDTH, _HEIGHT, parallax, seed)
    images = [cv2.resize(image, shape[1::-1]) for image in shot.images]
    return Material(images, simulate_prior(shot, seed=seed), shot.camera, *pose_arrays(shot.cam_from_world))


def _from_data(data: Path, generator: Generator) -> Material:
    shot = open_shot(data, str(generator.choice(STUDIO)), FULL)
    prior = open_prior("tcmonodepth", shot, data, data.parent / "models", HERE / "cache")
    assert prior is not None
    frames = [frame for frame, _ in zip(shot.frames(), range(_FRAMES), strict=False)]
    maps = [prior(frame) for frame in frames]
    depth = [None if found is None else found.values for found in maps]
    return Material([f.image for f in frames], depth, shot.camera, shot.rotations[:_FRAMES], shot.centers[:_FRAMES])


def _disturbed(kind: str, items: list[Item], shots: list[Material], generator: Generator) -> list[Item]:
    begin, count = int(generator.integers(0, len(items) - 4)), int(generator.integers(1, 7))
    chosen = range(begin, min(begin + count, len(items)))
    before, there, after = items[:begin], items[begin : chosen.stop], items[chosen.stop :]
    match kind:
        case "dropped frames":
            return before + after
        case "duplicated frames":
            return before + [item for item in there for _ in range(int(generator.integers(2, 5)))] + after
        case "black frames":
            return before + [Item(np.zeros_like(item.image), None) for item in there] + after
        case "noise instead of frames":
            noise = [generator.integers(0, 256, item.image.shape, np.uint8) for item in there]
            return before + [Item(image, None) for image in noise] + after
        case "damaged frames":
            return before + [replace(item, image=_damaged(item.image, generator)) for item in there] + after
        case "frame of another size":
            other = cv2.resize(there[0].image, None, fx=0.5, fy=0.5)
            return [*before, Item(other, None), *there, *after]
        case "stretch of another shot" | "cut to another shot":
            foreign = [Item(image, (1, k)) for k, image in enumerate(shots[1].images)]
            at = max(begin, 10)
            back = items[at:] if kind == FOREIGN else []
            return items[:at] + (foreign[: 2 * count] if back else foreign) + back
        case "depth of NaN" | "network that raises":
            word, share = ("nan" if kind == NAN_DEPTH else "raise"), generator.uniform(0.1, 1.0)
            return [replace(item, depth=word) if generator.random() < share else item for item in items]
    return items


def _damaged(image: Image, generator: Generator) -> Image:
    """Blocks of a broken stream: from some line on, rows of another place, and grey."""
    damaged, row = image.copy(), int(generator.integers(image.shape[0] // 3, image.shape[0] - 8))
    damaged[row:] = np.roll(image, int(generator.integers(20, 100)), axis=1)[row:] if generator.random() < 0.5 else 128
    return damaged


class Prior:
    """The maps of the items, with their trouble."""

    kind = DepthKind.INVERSE
    name = "maps with faults"

    def __init__(self, made: Plan) -> None:
        self._plan = made

    def __call__(self, frame: Frame) -> DepthMap | None:
        item = self._plan.items[frame.index]
        if item.depth == "raise":
            raise RuntimeError("out of memory")
        shot, k = item.origin or (0, 0)
        values = self._plan.shots[shot].depth[k]
        if values is None:
            return None
        return DepthMap(np.full_like(values, np.nan) if item.depth == "nan" else values, self.kind)


# --- the process of a run ---------------------------------------------------------------------------------------


def run(seed: int, folder: Path, data: Path | None) -> None:
    """Follow a plan to its end, or until it is time to be killed, and write down in `folder` how it went."""
    made = plan(seed, data)
    snapshot, log = folder / "state", folder / "updates.jsonl"
    (folder / "kinds").write_text("\n".join(made.kinds))
    outcome = Outcome(made.kinds)
    options = replace(Options(), tracker=replace(Options().tracker, max_tracks=400)) if data is None else Options()
    again = log.exists()
    target: Stream | Episode
    if again and snapshot.exists():
        target = Stream.load(snapshot, depth=Prior(made))
        begin = target.frames[-1].index + 1
    else:
        kind = Episode if made.film else Stream
        target = kind(made.shots[0].camera, depth=Prior(made), options=options)
        begin = 0
    if again and begin < (saved := _last_saved(log)):
        outcome.faults.append(f"frames up to {saved} were saved, but it goes on at {begin}")
    refused = 0
    with target, log.open("a") as lines:
        for index in range(begin, len(made.items)):
            if index == made.kill and not again:
                threading.Timer(made.delay, os.kill, (os.getpid(), signal.SIGKILL)).start()
            try:
                update = target.push(Frame(index, made.items[index].image, f"{index:06d}"))
            except InputError:
                refused += 1
                continue
            lines.write(json.dumps(_written(update)) + "\n")
            if isinstance(target, Stream) and KILLED in made.kinds and index % made.snapshot_every == 0:
                target.save(snapshot)
                lines.write(json.dumps({"saved": index + 1}) + "\n")
            lines.flush()
        if made.kill is not None and not again:
            signal.pause()
        outcome.end = f"{refused} refused, " if refused else ""
        outcome.end += _finished(target, made, outcome.faults)
    outcome.faults += _wrong_updates(log, made)
    (folder / "outcome.json").write_text(json.dumps({"end": outcome.end, "faults": outcome.faults}))


def _finished(target: Stream | Episode, made: Plan, faults: list[str]) -> str:
    results: list[Reconstruction] = []
    reasons: list[str] = []
    if isinstance(target, Episode):
        shots = target.finish()
        results = [shot.reconstruction for shot in shots if shot.reconstruction is not None]
        reasons = [shot.reason for shot in shots if shot.reconstruction is None]
    else:
        try:
            results.append(target.finish())
        except ReconstructionError as error:
            reasons.append(str(error))
    for result in results:
        faults += _wrong_result(result, made)
    return "; ".join([*(f"{len(r.registered)} of {len(r.frames)} frames" for r in results), *reasons])


def _wrong_result(result: Reconstruction, made: Plan) -> list[str]:
    """What is grossly wrong in a polished path."""
    found = [(frame.index, frame.cam_from_world) for frame in result.frames if frame.cam_from_world is not None]
    main, faults = _foreign(found, made)
    known = [(made.items[k].origin, pose) for k, pose in found if _origin(made, k) == main]
    if len(known) < _LEAST_POSES:
        return faults
    shot, order = made.shots[main], [origin[1] for origin, _ in known if origin is not None]
    errors = trajectory_errors(*pose_arrays([p for _, p in known]), shot.rotations[order], shot.centers[order])
    extent = float(np.linalg.norm(np.ptp(shot.centers[order], axis=0)))
    share, turn = float(np.nanmedian(errors.ate)) / extent, float(np.nanmedian(errors.r_rpe))
    if share > _WRONG_SHARE or turn > _WRONG_DEG:
        faults.append(f"the polished path is off by {100 * share:.0f} % of its extent, {turn:.2f} degrees")
    return faults


def _wrong_updates(log: Path, made: Plan) -> list[str]:
    """What is wrong among the poses that were given at once, and not declared void afterwards."""
    updates = {line["index"]: line for line in _lines(log) if "index" in line}
    faults: list[str] = []
    for number in sorted({line["shot"] for line in updates.values()}):
        lines = [updates[k] for k in sorted(updates) if updates[k]["shot"] == number]
        begin = max((row for row, line in enumerate(lines) if line["starts_anew"]), default=0)  # poses before are void
        lines = [line for line in lines[begin:] if line["pose"] is not None]
        found = [(line["index"], pycolmap.Rigid3d(np.array(line["pose"]))) for line in lines]
        main, foreign = _foreign(found, made)
        faults += foreign
        rows = [row for row, (k, _) in enumerate(found) if _origin(made, k) == main]
        if len(rows) < _LEAST_POSES:
            continue
        origins = [made.items[found[row][0]].origin for row in rows]
        order = [origin[1] for origin in origins if origin is not None]
        covariances = [None if (c := lines[row]["covariance"]) is None else np.array(c) for row in rows]
        shot = made.shots[main]
        off = sigmas([found[row][1] for row in rows], covariances, shot.rotations[order], shot.centers[order])
        faults += [
            f"frame {found[row][0]} is off by {s:.1f} sigma"
            for row, s in zip(rows, off, strict=True)
            if s > SIGMAS  # NaN has no covariance
        ]
    return faults


def _foreign(found: Sequence[tuple[int, Any]], made: Plan) -> tuple[int, list[str]]:
    """The shot to which most of the posed frames belong, and a fault for each of the others."""
    origins = [_origin(made, k) for k, _ in found]
    counts = Counter(origin for origin in origins if origin >= 0)
    if not counts:  # in a film, noise becomes a shot of its own
        return 0, []
    main = counts.most_common(1)[0][0]
    wrong = [k for (k, _), origin in zip(found, origins, strict=True) if origin != main]
    return main, [f"frame {k} has a pose, but shows nothing of the shot" for k in wrong]


def _origin(made: Plan, index: int) -> int:
    origin = made.items[index].origin
    return -1 if origin is None else origin[0]


def _written(update: FrameUpdate) -> dict[str, Any]:
    pose, covariance = update.cam_from_world, update.covariance
    return {
        "index": update.index,
        "shot": update.shot,
        "status": update.status,
        "pose": pose.matrix().tolist() if pose is not None else None,
        "covariance": covariance.tolist() if covariance is not None else None,
        "starts_anew": update.starts_anew,
    }


def _lines(log: Path) -> Iterator[dict[str, Any]]:
    for line in log.read_text().splitlines():
        with suppress(json.JSONDecodeError):  # the line at which the process was killed
            yield json.loads(line)


def _last_saved(log: Path) -> int:
    return max((line["saved"] for line in _lines(log) if "saved" in line), default=0)


# --- all runs ---------------------------------------------------------------------------------------------------


def watch(seed: int, arguments: argparse.Namespace) -> Outcome:
    """One run in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.faults", "--only", str(seed)]
    command += ["--data", str(arguments.data)] if arguments.data else []
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        outcome = Outcome([])
        for attempt in range(2):
            try:
                done = subprocess.run(
                    [*command, "--folder", name], capture_output=True, text=True, timeout=arguments.limit, check=False
                )
            except subprocess.TimeoutExpired:
                outcome.faults.append(f"hangs: no end within {arguments.limit:g} s")
                break
            killed = done.returncode == -signal.SIGKILL and attempt == 0 and KILLED in _kinds(folder)
            if killed:
                continue
            if done.returncode != 0:
                last = (done.stderr.strip().splitlines() or [""])[-1]
                outcome.faults.append(f"crashes with status {done.returncode}: {last}")
            break
        outcome.kinds = _kinds(folder)
        if (folder / "outcome.json").exists():
            content = json.loads((folder / "outcome.json").read_text())
            outcome.end = content["end"]
            outcome.faults += content["faults"]
    return outcome


def _kinds(folder: Path) -> list[str]:
    return (folder / "kinds").read_text().splitlines() if (folder / "kinds").exists() else []


def report(outcomes: dict[int, Outcome]) -> str:
    rows: list[list[object]] = []
    for kind in KINDS:
        of_kind = [outcome for outcome in outcomes.values() if kind in outcome.kinds]
        rows.append([kind, len(of_kind), *_counts(of_kind)])
    rows.append(["all runs", len(outcomes), *_counts(list(outcomes.values()))])
    header = [
        "trouble (one to three in a run)",
        "runs",
        "with a result",
        "with a reason",
        "hang",
        "crash",
        "wrong pose",
    ]
    failures = [
        f"- seed {seed} ({', '.join(outcome.kinds)}): {'; '.join(outcome.faults)}"
        for seed, outcome in outcomes.items()
        if outcome.faults
    ]
    return "\n\n".join([table(header, rows), "## Failures", "\n".join(failures) or "None."])


def _counts(outcomes: Sequence[Outcome]) -> list[int]:
    def having(word: str) -> int:
        return sum(any(fault.startswith(word) for fault in outcome.faults) for outcome in outcomes)

    results = sum(" frames" in outcome.end and " registered" not in outcome.end for outcome in outcomes)
    ended = sum(bool(outcome.end) for outcome in outcomes)
    return [results, ended - results, having("hangs"), having("crashes"), having("frame") + having("the polished")]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="of the first run")
    parser.add_argument("--limit", type=float, default=300.0, metavar="SECONDS", help="for a run")
    parser.add_argument("--data", type=Path, help="folder of the sets: shots of these, not rendered ones")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of FAULTS.md")
    parser.add_argument("--only", type=int, metavar="SEED", help="this run, in this process")
    parser.add_argument("--folder", type=Path, help="with --only: where it writes")
    arguments = parser.parse_args()
    if arguments.only is not None:
        run(arguments.only, arguments.folder, arguments.data)
        return
    outcomes: dict[int, Outcome] = {}
    for seed in range(arguments.first, arguments.first + arguments.runs):
        outcomes[seed] = watch(seed, arguments)
        print(seed, ", ".join(outcomes[seed].kinds), "->", outcomes[seed].end, outcomes[seed].faults or "", flush=True)
    shots = "shots of the development data" if arguments.data else "rendered shots"
    parts = [
        "# Faults",
        f"Generated by `python -m benchmarks.faults`. Machine: {machine()}; {len(outcomes)} runs on {shots}.",
        "A pose is wrong where it lies outside of its own 5-sigma region when it is given, where the frame shows "
        "nothing of the shot (unless the stream has said later that it starts anew, so that all poses before are "
        "void), or where the polished path is off by more than "
        f"{100 * _WRONG_SHARE:.0f} % of its extent or {_WRONG_DEG:g} degrees from frame to frame.",
        report(outcomes),
    ]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "FAULTS.md").write_text("\n\n".join(parts) + "\n")
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
