"""CPU time and memory of this process and of its child processes, such as that of the graph."""

from __future__ import annotations

import os
import resource
from pathlib import Path


def cpu_seconds() -> float:
    """CPU time of all of them so far, also of those that have ended."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    running = sum(_ticks(child) for child in _children()) / os.sysconf("SC_CLK_TCK")
    return sum(u.ru_utime + u.ru_stime for u in usage) + running


def peak_mb() -> float:
    """Sum of the peak memory of the running ones; shared memory counts for each."""
    return _status_mb("VmHWM")


def resident_mb() -> float:
    """Sum of the present memory of the running ones; shared memory counts for each."""
    return _status_mb("VmRSS")


def _children() -> list[Path]:
    lists = (_read(task / "children") for task in Path("/proc/self/task").iterdir())
    return [Path("/proc", child) for children in lists for child in children.split()]


def _ticks(process: Path) -> int:
    fields = _read(process / "stat").rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12]) if fields else 0  # utime, stime


def _status_mb(name: str) -> float:
    lines = "\n".join(_read(process / "status") for process in (Path("/proc/self"), *_children())).splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024.0


def _read(path: Path) -> str:
    """The text of a file; empty if its thread or process has ended."""
    try:
        return path.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""
