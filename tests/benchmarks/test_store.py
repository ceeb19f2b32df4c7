"""The keys of the cache: what they depend on, and that the kept records of COLMAP are still found."""

import subprocess
from pathlib import Path

import pytest

from benchmarks.plan import Cell
from benchmarks.store import _bare_code, cell_key

CACHE = Path(__file__).parents[2] / "benchmarks" / "cache"
CODE = 'from a import b\n\n\ndef f(x):\n    """Text."""\n    return b(x) + 1  # why\n'


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        (CODE.replace("from a", "from c.d"), True),
        (CODE.replace("Text", "Other text"), True),
        (CODE.replace("  # why", ""), True),
        (CODE.replace("+ 1", "+ 2"), False),
        (CODE.replace("b(x)", "c(x)"), False),
    ],
)
def test_only_code_that_runs_counts(tmp_path: Path, changed: str, same: bool) -> None:
    (tmp_path / "before.py").write_text(CODE)
    (tmp_path / "after.py").write_text(changed)
    assert (_bare_code(tmp_path / "before.py") == _bare_code(tmp_path / "after.py")) == same


def test_the_kept_records_belong_to_the_code_of_the_baselines(shared_data: Path) -> None:
    listed = subprocess.run(["git", "ls-files", "*.json"], cwd=CACHE, capture_output=True, text=True, check=True)
    records = [Path(name) for name in listed.stdout.splitlines()]
    assert len(records) > 80
    for record in records:
        variant, method, prior, key = record.stem.rsplit(".", 3)
        assert key == cell_key(Cell(record.parent.name, variant, method, prior), shared_data), record
