"""Reading of JSON: files, and the conversion of plain values to dataclasses."""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from factorsfm.support.errors import InputError

T = TypeVar("T")

_NAMES = {str: "text", bool: "true or false", int: "a whole number", float: "a number", dict: "an object"}
_LARGEST_WHOLE = 2**63


def read_json(path: str | Path, what: str) -> Any:
    """The content of a JSON file; a whole number beyond 64 bits becomes a float.

    Args:
        what: kind of the file, for the error message.

    Raises:
        InputError: the file cannot be read, or is not JSON.
    """
    try:
        return parse_json(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} {path} is not JSON: {error}") from error


def parse_json(text: str) -> Any:
    """The value of JSON text; a whole number beyond 64 bits becomes a float.

    Raises:
        ValueError, RecursionError: it is not JSON.
    """
    return json.loads(text, parse_int=_whole)


def typed(kind: type[T], value: Any, where: str) -> T:
    """Convert a plain value of JSON to a type; for a dataclass, this is the inverse of `asdict` and `json_text`.

    The type is a dataclass, an enumeration, a literal, a list, a dictionary with text keys, text, a number, a boolean,
    or one of these or None. Further keys of an object are ignored. null becomes NaN where a number is expected.

    Args:
        where: name of the value, for the error message.

    Raises:
        InputError: the value has another type, or a key is missing.
    """
    result: T = _typed(kind, value, where)
    return result


def _typed(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        (inner,) = (argument for argument in arguments if argument is not NoneType)
        return None if value is None else _typed(inner, value, where)
    if origin is Literal:
        return _one_of(arguments, value, where)
    if origin is list:
        if not isinstance(value, list):
            raise _unexpected(value, "a list", where)
        return [_typed(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value)]
    if origin is dict or is_dataclass(kind):
        if not isinstance(value, dict):
            raise _unexpected(value, _NAMES[dict], where)
        if origin is dict:
            return {key: _typed(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
        return _object(kind, value, where)
    if issubclass(kind, Enum):
        return kind(_one_of([item.value for item in kind], value, where))
    if kind is float:
        if value is None:
            return math.nan
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise _unexpected(value, _NAMES[float], where)
        return float(value)
    if type(value) is not kind:
        raise _unexpected(value, _NAMES[kind], where)
    return value


def _object(kind: Any, value: dict[str, Any], where: str) -> Any:
    hints, found = get_type_hints(kind), {}
    for field in fields(kind):
        if field.name in value:
            found[field.name] = _typed(hints[field.name], value[field.name], f"{where}.{field.name}")
        elif field.default is MISSING and field.default_factory is MISSING:
            raise InputError(f"{where}.{field.name} is missing")
    return kind(**found)


def _one_of(choices: Any, value: Any, where: str) -> Any:
    if not isinstance(value, str) or value not in choices:
        raise _unexpected(value, f"one of {', '.join(choices)}", where)
    return value


def _unexpected(value: Any, expected: str, where: str) -> InputError:
    text = repr(value)
    return InputError(f"{where} is {text if len(text) < 80 else f'{text[:77]}...'}; {expected} is expected")


def _whole(text: str) -> int | float:
    value = float(text)
    return int(text) if abs(value) <= _LARGEST_WHOLE else value
