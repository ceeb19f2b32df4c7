"""One run: follows a plan in this process, or in a process of its own that may be killed and resumed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.faults.plan import Fault, FaultyPrior, Plan, random_plan
from benchmarks.faults.verdict import last_saved, update_line, wrong_result, wrong_updates
from factorsfm import Episode, Frame, InputError, Options, Reconstruction, ReconstructionError, Stream

_RENDERED_TRACKS = 400  # `max_tracks` for rendered shots, which are small


@dataclass(slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        kinds: its faults.
        end: its results or the reasons for having none; empty if it did not end by itself.
        failures: what must not happen, in sentences.
    """

    kinds: list[str]
    end: str = ""
    failures: list[str] = field(default_factory=list)


def follow(seed: int, folder: Path, data: Path | None) -> None:
    """Follow a plan to its end, or until the process is killed, and write the outcome to `folder`."""
    plan = random_plan(seed, data)
    snapshot, log = folder / "state", folder / "updates.jsonl"
    (folder / "kinds").write_text("\n".join(plan.faults))
    outcome = Outcome([*plan.faults])
    is_resumed = log.exists()
    target, begin = _target(plan, snapshot if is_resumed else None, data)
    if is_resumed and begin < (saved := last_saved(log)):
        outcome.failures.append(f"frames up to {saved} were saved, but it goes on at {begin}")
    refused = 0
    with target, log.open("a") as lines:
        for index in range(begin, len(plan.frames)):
            if index == plan.killed_at and not is_resumed:
                threading.Timer(plan.kill_delay, os.kill, (os.getpid(), signal.SIGKILL)).start()
            try:
                update = target.push(Frame(index, plan.frames[index].image, f"{index:06d}"))
            except InputError:
                refused += 1
                continue
            lines.write(update_line(update) + "\n")
            if isinstance(target, Stream) and Fault.KILLED in plan.faults and index % plan.snapshot_every == 0:
                target.save(snapshot)
                lines.write(json.dumps({"saved": index + 1}) + "\n")
            lines.flush()
        if plan.killed_at is not None and not is_resumed:
            signal.pause()
        outcome.end = f"{refused} refused, " if refused else ""
        outcome.end += _finish(target, plan, outcome.failures)
    outcome.failures += wrong_updates(log, plan)
    (folder / "outcome.json").write_text(json.dumps({"end": outcome.end, "failures": outcome.failures}))


def run_apart(seed: int, data: Path | None, limit_seconds: float) -> Outcome:
    """Run a plan in a process of its own, and resume it once if the plan kills it."""
    command = [sys.executable, "-m", "benchmarks.faults", "--only", str(seed)]
    command += ["--data", str(data)] if data else []
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        outcome = Outcome([])
        for attempt in range(2):
            try:
                done = subprocess.run(
                    [*command, "--folder", name], capture_output=True, text=True, timeout=limit_seconds, check=False
                )
            except subprocess.TimeoutExpired:
                outcome.failures.append(f"hangs: no end within {limit_seconds:g} s")
                break
            if done.returncode == -signal.SIGKILL and attempt == 0 and Fault.KILLED in _kinds(folder):
                continue
            if done.returncode != 0:
                last = (done.stderr.strip().splitlines() or [""])[-1]
                outcome.failures.append(f"crashes with status {done.returncode}: {last}")
            break
        outcome.kinds = _kinds(folder)
        if (folder / "outcome.json").exists():
            content = json.loads((folder / "outcome.json").read_text())
            outcome.end = content["end"]
            outcome.failures += content["failures"]
    return outcome


def _target(plan: Plan, snapshot: Path | None, data: Path | None) -> tuple[Stream | Episode, int]:
    """What the frames are pushed to, new or from a snapshot that exists, and the first frame to push."""
    if snapshot is not None and snapshot.exists():
        stream = Stream.load(snapshot, depth=FaultyPrior(plan))
        return stream, stream.newest.index + 1
    options = Options()
    if data is None:
        options = replace(options, tracker=replace(options.tracker, max_tracks=_RENDERED_TRACKS))
    kind = Episode if plan.is_film else Stream
    return kind(plan.shots[0].camera, depth=FaultyPrior(plan), options=options), 0


def _finish(target: Stream | Episode, plan: Plan, failures: list[str]) -> str:
    """Finish the reconstruction: its results and reasons in words; what is wrong is added to `failures`."""
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
        failures += wrong_result(result, plan)
    return "; ".join([*(f"{len(r.registered)} of {len(r.frames)} frames" for r in results), *reasons])


def _kinds(folder: Path) -> list[str]:
    return (folder / "kinds").read_text().splitlines() if (folder / "kinds").exists() else []
