"""The name and the version of this program."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

PROGRAM = "factorsfm"


def program_version() -> str:
    """Version of the installed package, or "unknown" where it is not installed."""
    try:
        return version(PROGRAM)
    except PackageNotFoundError:
        return "unknown"
