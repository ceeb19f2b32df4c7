"""What the tests of several commands look at."""

from pathlib import Path
from typing import Any

import numpy as np


def trajectory(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "trajectory.tum")


def assert_error(captured: Any, *words: str) -> None:
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert line.startswith("factorsfm: error: ")
    for word in words:
        assert word in line
