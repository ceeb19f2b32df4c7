"""Measures all methods on all shots, and draws the tables: ``python -m benchmarks.run --data FOLDER``.

Every cell runs in a process of its own with a time limit. Its record is kept in the cache, so that an interrupted run
goes on where it stopped.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict
from fnmatch import fnmatch
from importlib.metadata import version
from itertools import groupby
from pathlib import Path

from benchmarks.cell import CODE_CHANGED, Folders, matches_folder, unregistered
from benchmarks.inputs import open_shot
from benchmarks.plan import COLMAP, CRF_30, EXPERIMENTS, NO_PRIOR, OTHERS, Cell, planned
from benchmarks.store import load, record_path, save

HERE = Path(__file__).parent
MANIFEST = "manifest.json"
_LIBRARIES = ("gtsam", "numpy", "opencv-python-headless", "onnxruntime", "pycolmap")


def main() -> None:
    arguments = _arguments()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that no cell outlives the run
    folders = Folders(arguments.data.resolve(), arguments.models.resolve(), arguments.cache.resolve())
    sets = {path.parent.name for path in folders.data.glob("*/*/groundtruth.txt")}
    plan = planned(sets, arguments.quick)
    if absent := sorted({cell.shot for cells in EXPERIMENTS.values() for cell in cells} - sets):
        _say(f"Not in {arguments.data}, and left out: {', '.join(absent)}.")
    chosen = {
        name: [cell for cell in cells if _wanted(cell, arguments)]
        for name, cells in plan.items()
        if not arguments.experiments or name in arguments.experiments
    }
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        _say(f"The variant {CRF_30} is left out: it needs the package imageio-ffmpeg.")
        chosen = {name: [cell for cell in cells if cell.variant != CRF_30] for name, cells in chosen.items()}
    if not any(chosen.values()):
        sys.exit(f"nothing to measure: of the {len(sets)} sets in {arguments.data} no cell is wanted")
    measure_all([cell for cells in chosen.values() for cell in cells], folders, arguments.timeout, arguments.retry)
    write_manifest(chosen, folders, arguments.output)

    from benchmarks.tables import draw

    draw(arguments.output, folders.cache)
    _say(f"Tables and figures: {arguments.output / 'RESULTS.md'}")


def measure_all(cells: Iterable[Cell], folders: Folders, timeout: float, retry: bool = False) -> None:
    """Measure the cells that the cache does not hold, and print a line for each.

    Args:
        timeout: seconds for a cell.
        retry: whether cells that failed before are measured again.
    """
    # Shot by shot, because the mappers of COLMAP share the matches of a shot.
    ordered = sorted(dict.fromkeys(cells), key=lambda cell: (cell.shot, cell.variant))
    missing = [cell for cell in ordered if not _is_measured(record_path(cell, folders.data, folders.cache), retry)]
    _say(f"{len(ordered)} cells, {len(ordered) - len(missing)} of them in the cache.")
    begin, done = time.monotonic(), 0
    for _, group in groupby(missing, key=lambda cell: (cell.shot, cell.variant)):
        members = list(group)
        for cell in members:
            start = time.monotonic()
            outcome = measure_cell(cell, folders, timeout)
            now, done = time.monotonic(), done + 1
            left = (now - begin) / done * (len(missing) - done) / 60.0
            _say(f"[{done}/{len(missing)}] {cell}: {outcome}  ({now - start:.0f} s, about {left:.0f} min left)")
        for cell in members:
            if cell.method in COLMAP:
                folder = matches_folder(cell, folders)
                for path in folder.parent.glob(f"{folder.name}*"):
                    shutil.rmtree(path, ignore_errors=True)


def measure_cell(cell: Cell, folders: Folders, timeout: float) -> str:
    """Measure one cell in a process of its own and keep its record; returns the outcome in a few words."""
    path = record_path(cell, folders.data, folders.cache)
    job = {"cell": asdict(cell), "record": str(path), **{k: str(v) for k, v in asdict(folders).items()}}
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.cell"],
        cwd=HERE.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    path.unlink(missing_ok=True)
    reason = ""
    try:
        _, log = process.communicate(json.dumps(job), timeout=timeout)
        if process.returncode == CODE_CHANGED:
            sys.exit("The code has changed since the start of the run: start it again.")
        if process.returncode:
            last = log.strip().splitlines()[-1:] or ["no message"]
            code = process.returncode
            reason = f"ended by {signal.Signals(-code).name}" if code < 0 else last[0]
    except subprocess.TimeoutExpired:
        reason = f"not finished after {timeout:.0f} s"
    finally:
        process.kill()
        process.wait()
    if reason:
        save(path, unregistered(cell, open_shot(folders.data, cell.shot, cell.variant), reason))
    record = load(path)
    if record.facts["failed"]:
        return f"failed: {record.facts['failed']}"
    return f"{record.registered}/{len(record.arrays['indices'])} frames"


def write_manifest(chosen: dict[str, list[Cell]], folders: Folders, output: Path) -> None:
    """Write beside the results which records belong to which experiment; experiments that did not run now stay."""
    output.mkdir(parents=True, exist_ok=True)
    path = output / MANIFEST
    known = json.loads(path.read_text()) if path.is_file() else {}
    # An experiment that ran on another machine has no records in this cache, so it cannot be drawn.
    manifest = {
        name: facts
        for name, facts in known.items()
        if all((folders.cache / record).is_file() for record in facts["records"])
    }
    if left_out := sorted(known.keys() - manifest.keys()):
        _say(f"Left out of the tables, since the cache lacks their records: {', '.join(left_out)}.")
    for name, cells in chosen.items():
        if cells:
            manifest[name] = {
                "command": shlex.join(["python", "-m", "benchmarks.run", *sys.argv[1:]]),
                "date": datetime.datetime.now().astimezone().isoformat(timespec="minutes"),
                "commit": _commit(),
                "machine": machine(),
                "versions": {name: version(name) for name in _LIBRARIES} | {"python": platform.python_version()},
                "records": [
                    str(record_path(cell, folders.data, folders.cache).relative_to(folders.cache)) for cell in cells
                ],
            }
    path.write_text(json.dumps(manifest, indent=1))


def machine() -> str:
    """Processor, cores and memory of this machine."""
    cpu = platform.processor() or platform.machine()
    if (info := Path("/proc/cpuinfo")).is_file():
        models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = models[0] if models else cpu
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{cpu}, {os.cpu_count()} cores, {memory:.0f} GB"


def _commit() -> str:
    """The commit, followed by + if files of the package have changed since."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "--", "../factorsfm") else "")


def _is_measured(path: Path, retry: bool) -> bool:
    return path.is_file() and not (retry and json.loads(path.read_text())["failed"])


def _wanted(cell: Cell, arguments: argparse.Namespace) -> bool:
    return (
        (not arguments.shots or any(fnmatch(cell.shot, f"{pattern}*") for pattern in arguments.shots))
        and (not arguments.methods or cell.method in arguments.methods)
        and (not arguments.priors or cell.prior in (NO_PRIOR, *arguments.priors))
    )


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder of the sets")
    add("--models", type=Path, help="folder of the networks (default: models beside the data)")
    add("--shots", nargs="+", metavar="NAME", help="only these, by the beginning of the name or a pattern")
    add("--methods", nargs="+", metavar="NAME", help="only these presets and baselines")
    add("--priors", nargs="+", metavar="NAME", help="of the methods that take a prior, only these, such as simulated")
    experiments = [*EXPERIMENTS, OTHERS]
    add("--experiments", nargs="+", choices=experiments, metavar="NAME", help=", ".join(experiments))
    add("--quick", action="store_true", help="a slice of a few minutes")
    add("--timeout", type=float, default=3600.0, help="seconds for a method on a shot (default: %(default).0f)")
    add("--retry", action="store_true", help="measure again what failed before")
    add("--cache", type=Path, default=HERE / "cache", help="folder of the records (default: benchmarks/cache)")
    add("--output", type=Path, help="default: benchmarks/results, with --quick the folder quick in the cache")
    arguments = parser.parse_args()
    if not arguments.data.is_dir():
        parser.error(f"--data {arguments.data} is not a folder")
    arguments.models = arguments.models or arguments.data.parent / "models"
    arguments.output = arguments.output or (arguments.cache / "quick" if arguments.quick else HERE / "results")
    return arguments


if __name__ == "__main__":
    main()
