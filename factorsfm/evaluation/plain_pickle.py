"""Reads pickles of numpy arrays and plain containers without executing any code in them."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

from factorsfm.support.errors import InputError

# The names in a pickle of arrays, dtypes, numpy scalars and plain containers.
_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("collections", "OrderedDict"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
}


def _latin1(text: str, encoding: str) -> bytes:
    """Decode bytes as pickles of protocol 2 and older hold them; no other codec is used."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it holds bytes encoded as {encoding!r}")
    return text.encode("latin1")


class _PlainUnpickler(pickle.Unpickler):
    """Finds the names of plain data only."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("_codecs", "encode"):
            return _latin1
        module = module.replace("numpy.core.", "numpy._core.").replace("__builtin__", "builtins")
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is no plain data")
        return super().find_class(module, name)


def load_plain_pickle(path: Path) -> Any:
    """The content of a pickle of numpy arrays, numbers, strings, lists, tuples, sets and dictionaries.

    Raises:
        InputError: the file cannot be read, or the pickle names anything else; none of its code is executed.
    """
    try:
        return _PlainUnpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()  # also from Python 2
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    except Exception as error:  # a damaged pickle can raise anything
        raise InputError(f"{path} is not a pickle of plain data: {error}") from error
