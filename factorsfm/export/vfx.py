"""The packages of the extra ``vfx``, imported where a format needs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from factorsfm.support.errors import InputError

_EXTRA_OF_MODULE = {"OpenEXR": "vfx", "pxr": "vfx", "alembic3d": "alembic", "imath": "alembic"}


def require(module: str) -> Any:
    """The module; its root has to be one of the known ones.

    Raises:
        InputError: it is not installed; says how to get it.
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
    """These packages raise a plain RuntimeError where a file cannot be written."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(str(error)) from error
