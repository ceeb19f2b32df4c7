"""The cache: one record (JSON and NPZ) per cell, under a key of everything on which its result depends."""

from __future__ import annotations

import ast
import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import factorsfm
from benchmarks.inputs import shot_folder
from benchmarks.plan import COLMAP, CRF_30, DEGRADED, Cell, undrawn
from factorsfm.evaluation.metrics import DepthErrors, TrajectoryErrors, rotation_angle, trajectory_errors

Array = NDArray[np.float64]

PACKAGE = Path(factorsfm.__file__).parent
_BASELINES = PACKAGE / "evaluation" / "baselines.py"
_DEGRADE = PACKAGE / "evaluation" / "degrade.py"


@dataclass(frozen=True, slots=True)
class Record:
    """A measured cell.

    Attributes:
        cell: what was measured.
        facts: plain data: `failed` (the reason, or None), `seconds` by stage with `total`, `cpu_seconds`, `peak_mb`,
            `load` (of the machine at the start), `parallax`, `kind`, `notes`, `settings`, `points`.
        arrays: `indices` (n,); `rotations` (n, 3, 3) and `centers` (n, 3), NaN for unregistered frames;
            `true_rotations` and `true_centers`; `given_rotations` and `given_centers` of a stream, the causal poses;
            the errors `ate` (n,), `t_rpe` and `r_rpe` (n - 1,); `depth` and `true_depth` (m,) of the observed points,
            metres.
    """

    cell: Cell
    facts: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    @property
    def errors(self) -> TrajectoryErrors:
        """Errors of the poses; computed from the poses, so that a change of the metrics needs no new run."""
        a = self.arrays
        return trajectory_errors(a["rotations"], a["centers"], a["true_rotations"], a["true_centers"])

    @property
    def given_errors(self) -> TrajectoryErrors | None:
        """Errors of the causal poses; None if the method waits for the whole shot."""
        a = self.arrays
        if "given_centers" not in a:
            return None
        return trajectory_errors(a["given_rotations"], a["given_centers"], a["true_rotations"], a["true_centers"])

    @property
    def rotation_errors(self) -> Array:
        """(n,) rotation error of every frame after alignment, degrees; infinite for unregistered frames."""
        alignment = self.errors.alignment
        if alignment is None:
            return np.full(len(self.arrays["indices"]), np.inf)
        angles = rotation_angle(alignment.rotations(self.arrays["rotations"]), self.arrays["true_rotations"])
        return np.where(np.isnan(angles), np.inf, angles)

    @property
    def depth_errors(self) -> DepthErrors:
        """Errors of the depths of the observed points."""
        return DepthErrors(self.arrays["depth"].astype(np.float64), self.arrays["true_depth"].astype(np.float64))

    @property
    def registered(self) -> int:
        """Number of registered frames."""
        return int(np.isfinite(self.arrays["centers"]).all(axis=1).sum())


def cell_key(cell: Cell, data: Path) -> str:
    """Key of the record: a digest of the cell, its data and the code that the method runs.

    The code counts without imports, comments, docstrings and layout. A baseline depends only on pycolmap and the module
    of the baselines, so that other changes of factorsfm leave its records in the cache.
    """
    folder = shot_folder(data, cell.shot)
    truth = hashlib.sha256((folder / "groundtruth.txt").read_bytes() + (folder / "camera.json").read_bytes())
    depends: dict[str, str] = {**asdict(cell), "truth": truth.hexdigest(), "code": code_version(cell.method)}
    if undrawn(cell.variant)[0] in (DEGRADED, CRF_30):
        depends["degrade"] = _fingerprint([_DEGRADE])
    return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:12]


@cache
def code_version(method: str) -> str:
    """Fingerprint of the code that a method runs, with the version of the library on which most depends."""
    if method in COLMAP:
        return f"{_fingerprint([_BASELINES])} pycolmap {version('pycolmap')}"
    ours = [path for path in sorted(PACKAGE.rglob("*.py")) if path.parent.name != "evaluation"]
    return f"{_fingerprint(ours)} gtsam {version('gtsam')}"


def record_path(cell: Cell, data: Path, cache_folder: Path) -> Path:
    """The JSON file of a record; its arrays are beside it, with the suffix .npz."""
    return cache_folder / cell.shot / f"{cell.variant}.{cell.method}.{cell.prior}.{cell_key(cell, data)}.json"


def save(path: Path, record: Record) -> None:
    """Write a record. The JSON file is written last, so that a record with one is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for target, write in ((path.with_suffix(".npz"), _write_arrays), (path, _write_facts)):
        scratch = target.with_name(f".{os.getpid()}.{target.name}")
        write(scratch, record)
        scratch.replace(target)


def load(path: Path) -> Record:
    """Read the record with this JSON file."""
    facts = json.loads(path.read_text())
    with np.load(path.with_suffix(".npz")) as arrays:
        return Record(Cell(**facts.pop("cell")), facts, dict(arrays))


def _write_facts(path: Path, record: Record) -> None:
    path.write_text(json.dumps({"cell": asdict(record.cell), **record.facts}, indent=1))


def _write_arrays(path: Path, record: Record) -> None:
    errors = record.errors
    arrays = {**record.arrays, "ate": errors.ate, "t_rpe": errors.t_rpe, "r_rpe": errors.r_rpe}
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _fingerprint(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        digest.update(f"{path.relative_to(PACKAGE)}\n{_bare_code(path)}\n".encode())
    return digest.hexdigest()[:16]


def _bare_code(path: Path) -> str:
    """Source without imports, comments, docstrings and layout, so that code which only moves keeps its records."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node, clean=False) else node.body
            node.body = [part for part in body if not isinstance(part, ast.Import | ast.ImportFrom)] or [ast.Pass()]
    return ast.unparse(tree)
