"""OpenLensIO, the lens of OpenTrackIO samples: to and from a camera.

Its radius is in mm on the sensor. Radial coefficients stand in turn in the numerator and in the denominator:
``(1 + l1 r^2 + l3 r^4 + l5 r^6) / (1 + l2 r^2 + l4 r^4 + l6 r^6)``. The model "Brown-Conrady U-D" takes undistorted
places to distorted ones, as COLMAP and OpenCV do; "Brown-Conrady D-U", the default, goes the other way.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.other_models import distorting
from factorsfm.camera.undistortion import distorts
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import typed

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_UD, _DU = "Brown-Conrady U-D", "Brown-Conrady D-U"
_POWERS = (2, 4, 6)  # of the radius
_BROWN = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})
_TOLD_SHARE = 1e-4  # of the image width, 0.2 pixels of 1920: a deviation that is worth a word
_SAME_MM = 1e-6
_LARGEST_MM, _LARGEST = 1e6, 1e12  # of lengths and coefficients: the powers of both stay finite


def distortion_of(camera: pycolmap.Camera, focal_mm: float) -> tuple[dict[str, Any] | None, float]:
    """The distortion of a sample, None without any, and its largest deviation over the image in pixels.

    Args:
        focal_mm: the focal length on the sensor of the sample.
    """
    if not distorts(camera):
        return None, 0.0
    p1 = p2 = deviation = 0.0
    numerator, denominator = np.zeros(3), np.zeros(3)
    if camera.model_name in _BROWN:
        extra = [float(camera.params[i]) for i in camera.extra_params_idxs()]
        k1, k2, p1, p2, *higher = [*extra, *(0.0,) * (8 - len(extra))]
        numerator, denominator = np.array([k1, k2, higher[0]]), np.array(higher[1:])
    else:
        fit = distorting(camera, 3, 1.0)
        numerator, deviation = np.array(fit.coefficients), fit.deviation_px
    unit = focal_mm ** np.array(_POWERS)
    radial = np.column_stack([numerator / unit, denominator / unit]).ravel()
    radial = radial[: max(1, np.flatnonzero(radial)[-1] + 1 if radial.any() else 1)]
    # The tangential part adds lengths, so that it has one focal length less than the square of a radius.
    found: dict[str, Any] = {"model": _UD, "radial": radial.tolist()}
    if p1 or p2:
        found["tangential"] = [p1 / focal_mm, p2 / focal_mm]
    return found, deviation


@dataclass(frozen=True, slots=True)
class _Size:
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class _Ratio:
    num: int
    denom: int


@dataclass(frozen=True, slots=True)
class _Camera:
    activeSensorPhysicalDimensions: _Size
    activeSensorResolution: _Size
    anamorphicSqueeze: _Ratio | None = None


@dataclass(frozen=True, slots=True)
class _Static:
    camera: _Camera


@dataclass(frozen=True, slots=True)
class _Offset:
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True, slots=True)
class _Distortion:
    radial: list[float]
    tangential: list[float] = field(default_factory=list)
    model: str = _DU


@dataclass(frozen=True, slots=True)
class _Lens:
    pinholeFocalLength: float
    distortion: list[_Distortion] = field(default_factory=list)
    projectionOffset: _Offset = field(default_factory=_Offset)
    distortionOffset: _Offset = field(default_factory=_Offset)


@dataclass(frozen=True, slots=True)
class _Sample:
    static: _Static
    lens: _Lens


def content_of_sample(sample: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a camera file (`camera_from_json`) for a sample.

    Raises:
        InputError: the sample does not say all of a lens, or says what a camera cannot have.
    """
    found = typed(_Sample, sample, "OpenTrackIO")
    camera, lens = found.static.camera, found.lens
    squeeze = camera.anamorphicSqueeze
    if squeeze is not None and squeeze.num != squeeze.denom:
        raise InputError(
            f"anamorphicSqueeze is {squeeze.num}/{squeeze.denom}; 1 is expected, with the squeeze in the sensor's size"
        )
    sensor, pixels = camera.activeSensorPhysicalDimensions, camera.activeSensorResolution
    for name, value in (
        ("sensor width", sensor.width), ("sensor height", sensor.height), ("focal length", lens.pinholeFocalLength),
    ):  # fmt: skip
        if not 1 / _LARGEST_MM <= value <= _LARGEST_MM:
            raise InputError(f"the {name} is {value:g}; mm from {1 / _LARGEST_MM:g} to {_LARGEST_MM:g} are expected")
    scale = np.array([pixels.width / sensor.width, pixels.height / sensor.height])
    offset = lens.projectionOffset
    if not max(abs(offset.x), abs(offset.y)) <= _LARGEST_MM:
        raise InputError(f"projectionOffset is {offset.x:g}, {offset.y:g}; mm up to {_LARGEST_MM:g} are expected")
    focal = lens.pinholeFocalLength * scale
    center = np.array([pixels.width, pixels.height]) / 2 + np.array([offset.x, offset.y]) * scale - 0.5
    chosen = next((one for one in lens.distortion if one.model == _UD), next(iter(lens.distortion), None))
    if chosen is not None and max(abs(lens.distortionOffset.x), abs(lens.distortionOffset.y)) > _SAME_MM:
        raise InputError("distortionOffset is not 0; the distortion is expected about the centre of projection")
    extra = [] if chosen is None else _coefficients(chosen, lens.pinholeFocalLength, sensor)
    size = {"width": pixels.width, "height": pixels.height}
    return {**size, "model": model_of(extra), "params": [*focal.tolist(), *center.tolist(), *extra]}


def model_of(extra: Sequence[float]) -> str:
    """COLMAP's model with these parameters after the principal point."""
    return {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(extra)]


def _coefficients(given: _Distortion, focal_mm: float, sensor: _Size) -> list[float]:
    """k1, k2, p1, p2 of OpenCV and COLMAP, and k3 to k6 where there are more."""
    if given.model not in (_UD, _DU):
        raise InputError(f'the distortion is "{given.model}"; "{_UD}" or "{_DU}" is expected')
    if len(given.radial) > 6 or len(given.tangential) > 2:
        raise InputError(
            f"the distortion has {len(given.radial)} radial and {len(given.tangential)} tangential coefficients; "
            "at most 6 and 2 are expected"
        )
    if not all(abs(k) <= _LARGEST for k in (*given.radial, *given.tangential)):
        raise InputError(f"a distortion coefficient is not a number up to {_LARGEST:g}")
    radial = np.array([*given.radial, *(0.0,) * (6 - len(given.radial))]).reshape(3, 2)
    radial *= (focal_mm ** np.array(_POWERS))[:, None]
    tangential = np.array([*given.tangential, *(0.0,) * (2 - len(given.tangential))]) * focal_mm
    if given.model == _DU:
        radial, tangential = _inverted(radial, tangential, np.array([sensor.width, sensor.height]) / focal_mm / 2)
    k, d = radial.T.tolist()
    return [*k[:2], *tangential.tolist(), *([k[2], *d] if k[2] or any(d) else [])]


def _inverted(radial: Array, tangential: Array, corner: Array) -> tuple[Array, Array]:
    """Coefficients that distort, of some that undistort, by least squares over the image.

    Args:
        radial: (3, 2) of numerator and denominator; corner: (2,) of the image, in focal lengths from its middle.
    """
    grid = np.stack(np.meshgrid(*(np.linspace(-end, end, 41) for end in corner)), axis=-1).reshape(-1, 2)
    square = (grid**2).sum(axis=1)
    powers = square[:, None] ** np.arange(1, 4)
    below = 1 + powers @ radial[:, 1]
    straight = grid * ((1 + powers @ radial[:, 0]) / np.where(below, below, np.nan))[:, None]
    straight += _tangential(grid) @ tangential
    if not np.abs(straight).max() <= _LARGEST_MM:
        raise InputError("the distortion leaves the image")
    powers = (straight**2).sum(axis=1)[:, None] ** np.arange(1, 4)
    columns = np.concatenate([straight[:, :, None] * powers[:, None], _tangential(straight)], axis=2)
    found = np.linalg.lstsq(columns.reshape(-1, 5), (grid - straight).ravel(), rcond=None)[0]
    away = np.linalg.norm(grid - straight - columns @ found, axis=1).max() / (2 * corner[0])
    if away > _TOLD_SHARE:
        logger.warning("a lens from distorted to undistorted places is turned: %.2g of the image's width away", away)
    return np.column_stack([found[:3], np.zeros(3)]), found[3:]


def _tangential(places: Array) -> Array:
    """(n, 2, 2) what p1 and p2 add to x and y."""
    x, y = places.T
    square = x**2 + y**2
    p1 = np.stack([2 * x * y, square + 2 * y**2], axis=1)
    return np.stack([p1, np.stack([square + 2 * x**2, 2 * x * y], axis=1)], axis=2)
