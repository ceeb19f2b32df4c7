"""Reading of recordings of an IMU: CSV with named columns, EuRoC's, and gyroflow's .gcsv."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.inertial.recording import ImuRecording
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

_LARGEST_FILE = 1 << 30  # bytes: three hours of a thousand samples a second
_LARGEST_HEAD = 1 << 16  # bytes
_STANDARD_GRAVITY = 9.80665  # m/s^2 in a g
_DEGREE = math.pi / 180
_GYROFLOW = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")

# The units a name of a column may end in, and what they are in seconds, rad/s or m/s^2; "" is no unit.
_UNITS = {
    "time": {"": 1.0, "_s": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9},
    "gyro": {"": 1.0, "_rad": 1.0, "_deg": _DEGREE},
    "accel": {"": 1.0, "_ms2": 1.0, "_g": _STANDARD_GRAVITY},
}
_QUANTITIES = ("time", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_EUROC = (
    "#timestamp [ns]",
    *(f"w_rs_s_{axis} [rad s^-1]" for axis in "xyz"),
    *(f"a_rs_s_{axis} [m s^-2]" for axis in "xyz"),
)
_GCSV = ("t", "gx", "gy", "gz", "ax", "ay", "az")
# By the first letter of a column: the key of its scale, its default and the unit that the scale leads to.
_GCSV_SCALES = {"t": ("tscale", "0.001", 1.0), "g": ("gscale", "1", 1.0), "a": ("ascale", "1", _STANDARD_GRAVITY)}


def read_imu(path: str | Path) -> ImuRecording:
    """Read the recording of an IMU. Its clock and axes are those of the file; rotation and time offset stay unknown.

    Three kinds of text are read, told apart by their first line:

    - CSV whose first line names the columns, in any order; others are ignored. They are ``time`` (seconds), ``gyro_x``,
      ``gyro_y``, ``gyro_z`` (rad/s), ``accel_x``, ``accel_y`` and ``accel_z`` (m/s^2, with gravity: 9.81 upwards at
      rest). Another unit stands at the end of the name: ``time_ms``, ``time_us``, ``time_ns``; ``gyro_x_deg`` (degrees
      a second); ``accel_x_g`` (9.80665 m/s^2). The units may be spelled out, too: ``time_s``, ``gyro_x_rad``,
      ``accel_x_ms2``.
    - The ``imu0/data.csv`` of EuRoC (Burri et al. 2016): ``#timestamp [ns],w_RS_S_x [rad s^-1],...``.
    - gyroflow's .gcsv with a gyroscope and an accelerometer: ``GYROFLOW IMU LOG``, its keys, and
      ``t,gx,gy,gz,ax,ay,az``, scaled by ``tscale`` (seconds), ``gscale`` (rad/s) and ``ascale`` (g). The letters of
      ``orientation`` say which axis of the file is gyroflow's x, y and z, a small one with its sign changed: ``YxZ`` is
      ``(y, -x, z)``.

    Raises:
        InputError: the file cannot be read, is not one of these, lacks a column or holds what is no number; or
            `ImuRecording` refuses the samples.
    """
    path = Path(path)
    names, skip, keys = _head(path)
    columns, factors = _columns(path, names, keys)
    with np.errstate(over="ignore"):  # infinity is refused below
        samples = _samples(path, skip, columns, len(names)) * factors
    gyroscope, accelerometer = samples[:, 1:4], samples[:, 4:]
    if keys is not None:
        order, signs = _orientation(path, keys.get("orientation", "XYZ"))
        gyroscope, accelerometer = gyroscope[:, order] * signs, accelerometer[:, order] * signs
    try:
        return ImuRecording(samples[:, 0], gyroscope, accelerometer)
    except InputError as error:
        raise InputError(f"IMU file {path}: {error}") from error


def _head(path: Path) -> tuple[list[str], int, dict[str, str] | None]:
    """The names of the columns, the number of lines up to them, and the keys of gyroflow's; None for other files."""
    try:
        with path.open("rb") as file:
            block = file.read(_LARGEST_HEAD)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"IMU file {path} cannot be read: {error.strerror or error}") from error
    if size > _LARGEST_FILE:
        raise InputError(f"IMU file {path} has {size / 2**30:.1f} GiB; at most {_LARGEST_FILE >> 30} GiB is read")
    try:
        # A character may be cut where the block ends.
        text = (
            block.decode("utf-8-sig") if len(block) < _LARGEST_HEAD else block[: block.rfind(b"\n")].decode("utf-8-sig")
        )
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise InputError(f"IMU file {path} is no text; CSV or .gcsv is expected")
    lines = text.splitlines()
    if not text.strip():
        raise InputError(f"IMU file {path} is empty")
    if lines[0].strip() not in _GYROFLOW:
        return lines[0].split(","), 1, None
    keys: dict[str, str] = {}
    for number, line in enumerate(lines[1:], 2):
        key, _, value = line.partition(",")
        if key.strip() in ("t", "time"):
            return ["t", *value.split(",")], number, keys
        keys[key.strip()] = value.strip()
    raise InputError(f'IMU file {path} is a gyroflow log without the line "{",".join(_GCSV)}"')


def _columns(path: Path, names: list[str], keys: dict[str, str] | None) -> tuple[list[int], Array]:
    """Where time, gyroscope and accelerometer stand among the names, (7,), and the factors to their units, (7,)."""
    found: dict[int, tuple[int, float]] = {}
    for column, name in enumerate(names):
        known = _gcsv_column(path, name, keys) if keys is not None else _column(name)
        if known is not None:
            if known[0] in found:
                raise InputError(f'IMU file {path} has "{_QUANTITIES[known[0]]}" in two columns')
            found[known[0]] = column, known[1]
    missing = [name for k, name in enumerate(_GCSV if keys is not None else _QUANTITIES) if k not in found]
    if missing:
        raise InputError(
            f"IMU file {path} has no column {', '.join(missing)}; its first line must name the columns "
            f"{','.join(_QUANTITIES)}, or be that of EuRoC or of a gyroflow log"
        )
    return [found[k][0] for k in range(7)], np.array([found[k][1] for k in range(7)])


def _column(name: str) -> tuple[int, float] | None:
    """The quantity that the name of a column means, and its factor; None for another."""
    name = " ".join(name.lower().split())
    if name in _EUROC:
        return _EUROC.index(name), 1e-9 if name == _EUROC[0] else 1.0
    match = re.fullmatch(r"(time|gyro|accel)((?:_[xyz])?)((?:_\w+)?)", name)
    if match is None or match[1] + match[2] not in _QUANTITIES or match[3] not in _UNITS[match[1]]:
        return None
    return _QUANTITIES.index(match[1] + match[2]), _UNITS[match[1]][match[3]]


def _gcsv_column(path: Path, name: str, keys: dict[str, str]) -> tuple[int, float] | None:
    name = name.strip()
    if name not in _GCSV:
        return None
    key, default, unit = _GCSV_SCALES[name[0]]
    text = keys.get(key, default)
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f'IMU file {path} has the {key} "{text}"; a positive number is expected')
    return _GCSV.index(name), scale * unit


def _orientation(path: Path, letters: str) -> tuple[list[int], list[float]]:
    """Which axis of a gyroflow log is gyroflow's x, y and z, and its sign."""
    if sorted(letters.lower()) != ["x", "y", "z"]:
        raise InputError(f'IMU file {path} has the orientation "{letters}"; x, y and z in any order are expected')
    return ["xyz".index(letter.lower()) for letter in letters], [
        1.0 if letter.isupper() else -1.0 for letter in letters
    ]


def _samples(path: Path, skip: int, columns: list[int], count: int) -> Array:
    """The numbers (n, 7) in these columns below the head."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without samples
            samples = np.loadtxt(
                path, delimiter=",", skiprows=skip, usecols=columns, comments=None, ndmin=2, encoding="utf-8-sig"
            )
    except (ValueError, OSError) as error:
        raise InputError(_what_is_wrong(path, skip, columns, count)) from error
    if not samples.size:
        raise InputError(f"IMU file {path} has no samples below its head")
    return np.asarray(samples, np.float64)


def _what_is_wrong(path: Path, skip: int, columns: list[int], count: int) -> str:
    """One sentence on the first line that is none of samples."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            cells = line.rstrip("\r\n").split(",")
            if number <= skip or not line.strip():
                continue
            if len(cells) <= max(columns):
                return f"line {number} of IMU file {path} has {len(cells)} columns; {count} are expected"
            for column in columns:
                try:
                    float(cells[column])
                except ValueError:
                    return (
                        f"line {number} of IMU file {path} holds {cells[column].strip()[:40]!r}; a number is expected"
                    )
    return f"IMU file {path} cannot be read as columns of numbers"
