"""Which constants matter: each at 0.7 and 1.4 times its value, on a slice of the shots.

    python -m benchmarks.sensitivity --data FOLDER [--rooms mapping graph] [--only NAME] [--jobs 2]

Measured are the numbers that the modules of the product name in capitals, and those of its options; a pair or triple of
numbers changes as a whole. One that no function names which these shots run is not measured. Every measurement runs in
a process of its own and is kept in sensitivity.json beside the table, so that an interrupted run goes on where it
stopped. What costs much on the slice is measured on all studio shots, too: there chance is smaller.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import multiprocessing
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np

import factorsfm
from benchmarks.inputs import open_prior, open_shot
from benchmarks.markdown import table
from benchmarks.plan import FULL, STUDIO
from benchmarks.run import HERE, machine
from factorsfm import MaskFolder, Options, ReconstructionError, Stream
from factorsfm.evaluation.metrics import auc, trajectory_errors
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.graph.process import GraphProcess
from factorsfm.streaming import stream as streaming
from factorsfm.support.similarity import pose_arrays

RESULTS = Path(__file__).parent / "results"
SHOTS = ("d03_livingroom_handheld", "d08_arena_pedestal")
FRAMES = 32  # of each shot: young maps are where settings matter most
ROOMS = (
    "tracks", "priors", "adjustment", "graph", "motion", "mapping", "lens", "polish", "streaming", "support", "options",
)  # fmt: skip
FACTORS = (0.7, 1.4)
MUCH, LITTLE = 3.0, 0.5  # points of a column
_SECONDS = 300  # of a measurement, twenty times as long as it takes
COLUMNS = (("ATE", 0.002), ("ATE", 0.02), ("T-RPE", 0.001), ("T-RPE", 0.005), ("R-RPE", 0.02), ("R-RPE", 0.1))

ON_ALL = "on all: "  # begins the keys of what is measured on all studio shots

Scores = dict[str, list[float]]
Changes = dict[str, float]
_Found = TypeVar("_Found")


@dataclass(frozen=True, slots=True)
class Constant:
    """A number of the product.

    Attributes:
        place: module below `factorsfm`, or the options it belongs to; name: in there.
        value: a number or several.
    """

    place: str
    name: str
    value: float | tuple[float, ...]

    @property
    def key(self) -> str:
        """Names it in the records."""
        return f"{self.place}:{self.name}"

    def changed(self, factor: float) -> float | tuple[float, ...]:
        """The value times a factor; a whole number stays one, and becomes another."""
        if isinstance(self.value, tuple):
            return tuple(_times(value, factor) for value in self.value)
        return _times(self.value, factor)


def _times(value: float, factor: float) -> float:
    if isinstance(value, int):
        return max(0, min(round(factor * value), value - 1) if factor < 1.0 else max(round(factor * value), value + 1))
    return factor * value


def constants(room: str) -> Iterator[Constant]:
    """Those of a room, or the options."""
    if room == "options":
        for part in ("tracker", "mapper", "polish"):
            values = getattr(Options(), part)
            for field in fields(values):
                if _is_number(value := getattr(values, field.name)):
                    yield Constant(part, field.name, value)
        return
    package = Path(factorsfm.__file__).parent
    for path in sorted((package / room).glob("*.py")):
        for name, value in _assigned(ast.parse(path.read_text())):
            if name.isupper() and (_is_number(value) or (isinstance(value, tuple) and all(map(_is_number, value)))):
                yield Constant(f"{room}.{path.stem}", name, value)


def _assigned(module: ast.Module) -> Iterator[tuple[str, Any]]:
    """Names and values that a module assigns as plain literals."""
    for statement in module.body:
        if not isinstance(statement, ast.Assign):
            continue
        try:
            value = ast.literal_eval(statement.value)
        except ValueError:
            continue
        target = statement.targets[0]
        if isinstance(target, ast.Tuple):
            yield from zip((name.id for name in target.elts if isinstance(name, ast.Name)), value, strict=True)
        elif isinstance(target, ast.Name):
            yield target.id, value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class _GraphHere(GraphProcess):
    """The graph in this process, where the constant is changed."""

    def __init__(self, module: str) -> None:
        super().__init__(module)
        self._graph = KeyframeGraph()

    def ask(self, update: Any, subject: Any) -> Any:
        """As there."""
        if self._anew:
            self._graph, self._anew = KeyframeGraph(), False
        return update(subject, self._graph)


def measure(constant: Constant | None, factor: float, data: Path, shots: tuple[str, ...]) -> Scores:
    """Columns in percent, pooled over the shots, of the live and of the polished poses."""
    options = Options()
    if constant is not None and "." not in constant.place:
        part = replace(getattr(options, constant.place), **{constant.name: constant.changed(factor)})
        options = replace(options, **{constant.place: part})
    elif constant is not None:
        home = importlib.import_module(f"factorsfm.{constant.place}")
        value = getattr(home, constant.name)
        for name, module in list(sys.modules.items()):
            if name.startswith("factorsfm") and getattr(module, constant.name, None) is value:
                setattr(module, constant.name, constant.changed(factor))
    errors: dict[str, list[Any]] = {"graph": [], "polished": []}
    with patch.object(streaming, "GraphProcess", _GraphHere):
        for shot in shots:
            for name, found in _errors(shot, data, options).items():
                errors[name].append((found.ate, found.t_rpe, found.r_rpe))
    kinds = ("ATE", "T-RPE", "R-RPE")
    pooled = {
        name: dict(zip(kinds, map(np.concatenate, zip(*found, strict=True)), strict=True))
        for name, found in errors.items()
    }
    return {name: [auc(found[kind], limit) for kind, limit in COLUMNS] for name, found in pooled.items()}


def names_run(data: Path, shots: tuple[str, ...]) -> set[str]:
    """Names of module level and of attributes in all functions that run on the shots: what else is changed is not read.

    They do not tell equal names of two modules apart: some constants are measured for nothing.
    """
    names: set[str] = set()

    def profile(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            names.update(frame.f_code.co_names)

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        measure(None, 1.0, data, shots)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return names


def _errors(name: str, data: Path, options: Options) -> dict[str, Any]:
    shot = open_shot(data, name, FULL)
    depth = open_prior("tcmonodepth", shot, data, data.parent / "models", HERE / "cache")
    masks = MaskFolder(shot.masks) if shot.masks is not None else None
    with Stream(shot.camera, depth=depth, masks=masks, options=options) as stream:
        for frame in islice(shot.frames(), FRAMES):
            stream.push(frame)
        poses = {"graph": stream.trajectory()}
        try:
            poses["polished"] = [frame.cam_from_world for frame in stream.finish().frames]
        except ReconstructionError:
            poses["polished"] = [None] * FRAMES
    true = shot.rotations[:FRAMES], shot.centers[:FRAMES]
    return {kind: trajectory_errors(*pose_arrays(found), *true) for kind, found in poses.items()}


def apart(work: Callable[..., _Found], *arguments: object) -> _Found | None:
    """What a function gives in a process of its own; None where it fails, or does not end: solvers may not converge."""
    spawn = multiprocessing.get_context("spawn")
    receiver, sender = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_send, args=(sender, work, arguments))
    process.start()
    sender.close()
    try:
        found: _Found | None = receiver.recv() if receiver.poll(_SECONDS) else None
    except EOFError:
        found = None
    finally:
        process.kill()
        process.join()
    return found


def _send(sender: Connection, work: Callable[..., object], arguments: Sequence[object]) -> None:
    sender.send(work(*arguments))


def losses_of(records: dict[str, Scores]) -> dict[str, list[Changes]]:
    """By constant and factor, the largest loss in a column of each kind of poses; empty where the product cannot do."""
    base = records["unchanged"]
    losses: dict[str, list[Changes]] = {}
    for key, found in records.items():
        if key != "unchanged" and not key.startswith(ON_ALL):
            changes = {name: float(np.min(np.subtract(found[name], base[name]))) for name in found}
            losses.setdefault(key.rpartition(" ")[0], []).append(changes)
    return losses


def worst_of(losses: dict[str, list[Changes]]) -> dict[str, float]:
    """The largest loss of each constant that can be changed."""
    return {name: min(min(c.values()) for c in changes) for name, changes in losses.items() if all(changes)}


def _row(name: str, changes: list[Changes]) -> list[str]:
    return [f"`{name}`", *(f"{c['graph']:+.1f} / {c['polished']:+.1f}" for c in changes)]


def report(records: dict[str, Scores], shots: tuple[str, ...], rooms: Sequence[str]) -> str:
    """The constants that matter, the worst first, and how many do not."""
    base, losses = records["unchanged"], losses_of(records)
    fixed = sorted(name for name, changes in losses.items() if not all(changes))
    worst = worst_of(losses)
    header = ["constant", *(f"times {factor:g}: live / polished" for factor in FACTORS)]
    rows = [_row(name, losses[name]) for name in sorted(worst, key=lambda name: worst[name]) if worst[name] <= -LITTLE]
    on_all = losses_of({key.removeprefix(ON_ALL): found for key, found in records.items() if key.startswith(ON_ALL)})
    return "\n\n".join(
        [
            "# Sensitivity",
            f"`python -m benchmarks.sensitivity --data FOLDER --rooms {' '.join(rooms)}`. Machine: {machine()}. The "
            f"first {FRAMES} frames of {', '.join(shots)}, TCMonoDepth at the keyframes, known lens. Of {len(worst)} "
            "constants in these rooms that the shots meet, changed one at a time, "
            f"{sum(loss < -MUCH for loss in worst.values())} cost more than {MUCH:g} points in a pooled column, and "
            f"{len(worst) - len(rows)} less than {LITTLE:g}.",
            "Unchanged: "
            + "; ".join(f"{name} {' / '.join(f'{value:.1f}' for value in found)}" for name, found in base.items())
            + ". The largest loss in any of these columns, of the live and of the polished poses:",
            table(header, rows),
            f"Those that cost more than {MUCH:g} points, on the first {FRAMES} frames of all studio shots:",
            table(header, [_row(name, changes) for name, changes in on_all.items()]),
            f"The program does not run with another: {', '.join(f'`{name}`' for name in fixed) or 'none'}.",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sensitivity", description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, choices=ROOMS, metavar="ROOM")
    parser.add_argument("--only", default="", metavar="NAME", help="only constants whose key contains this")
    parser.add_argument("--shots", nargs="+", default=SHOTS, metavar="NAME")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    kept, shots = arguments.output / "sensitivity.json", tuple(arguments.shots)
    records: dict[str, Scores] = json.loads(kept.read_text()) if kept.exists() else {}
    met = apart(names_run, arguments.data, shots)
    if met is None:
        sys.exit("the measurement fails without any change; see above")
    plan: dict[str, tuple[Constant | None, float]] = {"unchanged": (None, 1.0)}
    for constant in (c for room in arguments.rooms for c in constants(room) if c.name in met):
        if arguments.only in constant.key:
            plan |= {f"{constant.key} {factor:g}": (constant, factor) for factor in FACTORS}

    def measured(plan: dict[str, tuple[Constant | None, float]], shots: tuple[str, ...]) -> None:
        with ThreadPoolExecutor(arguments.jobs) as pool:
            jobs = {
                key: pool.submit(apart, measure, constant, factor, arguments.data, shots)
                for key, (constant, factor) in plan.items()
                if key not in records
            }
            for key, job in jobs.items():
                records[key] = job.result() or {}  # nothing: the product cannot do with that value
                kept.write_text(json.dumps(records, indent=1))
                print(key, records[key], flush=True)

    measured(plan, shots)
    worst = worst_of(losses_of({key: records[key] for key in plan}))
    costly = {name for name, loss in worst.items() if loss < -MUCH}
    plan_on_all = {
        ON_ALL + key: what for key, what in plan.items() if key == "unchanged" or key.rpartition(" ")[0] in costly
    }
    measured(plan_on_all, STUDIO)
    plan |= plan_on_all
    text = report({key: records[key] for key in plan}, shots, arguments.rooms)
    (arguments.output / "SENSITIVITY.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
