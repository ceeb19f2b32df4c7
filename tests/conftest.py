"""Fixtures shared by all tests."""

import os
import signal
from pathlib import Path

import pytest

# Before NumPy is imported: the workers share the cores, and threads of BLAS would wait for each other in each of them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SHARED = Path(os.environ.get("FACTORSFM_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def pytest_configure() -> None:
    """Ctrl-C reaches the processes of the tests also where a shell runs the suite in the background, without it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _shared(folder: str) -> Path:
    path = SHARED / folder
    if not path.is_dir():
        pytest.skip(f"development {folder} not found at {path} (set FACTORSFM_SHARED)")
    return path


@pytest.fixture
def shared_data() -> Path:
    """Folder with the development shots; skips the test where it is absent."""
    return _shared("data")


@pytest.fixture
def shared_models() -> Path:
    """Folder with the development networks; skips the test where it is absent."""
    return _shared("models")
