"""Optional packages of the extras ``vfx`` and ``alembic``, imported when a format needs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from factorsfm.support.errors import InputError

_EXTRA_OF_MODULE = {"pxr": "vfx", "alembic3d": "alembic", "imath": "alembic"}


def require(module: str) -> Any:
    """Import a module of an optional package.

    Raises:
        InputError: the package is not installed; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        root = module.partition(".")[0]
        raise InputError(
            f"this format needs the package {root}: pip install 'factorsfm[{_EXTRA_OF_MODULE[root]}]'"
        ) from error


@contextmanager
def failures_as_os_errors() -> Iterator[None]:
    """Turns the RuntimeError that these packages raise for a file into an OSError."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(str(error)) from error
