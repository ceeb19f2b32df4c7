"""A lens in the models of other programs: their coefficients, fitted to it, and how far from it they are.

All of these models scale the place of a pixel about a centre by a polynomial of its radius. They differ in the unit of
the radius, and in the direction: whether the polynomial takes undistorted places or distorted ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

_ACROSS, _DOWN = 65, 37  # places of the image, its corners included, that a model is fitted to


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A lens in another model.

    Attributes:
        coefficients: of even powers of the radius, from the second on.
        deviation_px: largest distance from where the lens itself puts a pixel, over the whole image.
    """

    coefficients: tuple[float, ...]
    deviation_px: float


def distorting(camera: pycolmap.Camera, count: int, unit: float) -> FittedModel:
    """``distorted = undistorted * (1 + k1 r^2 + ...)`` about the principal point, r of the undistorted place.

    Args:
        count: number of coefficients; unit: of the radius, focal lengths.
    """
    straight, bent = _places(camera)
    return _fitted(straight, bent, straight, count, unit, _focal(camera))


def undistorting(camera: pycolmap.Camera, count: int, unit: float) -> FittedModel:
    """``undistorted = distorted * (1 + k1 r^2 + ...)`` about the principal point, r of the distorted place."""
    straight, bent = _places(camera)
    return _fitted(bent, straight, bent, count, unit, _focal(camera))


def dividing(camera: pycolmap.Camera, count: int) -> FittedModel:
    """``undistorted = distorted / (1 + k1 r^2 + ...)`` about the middle of the image, r of the distorted place.

    Pixels count as square, and the radius in halves of the longer side of the image.
    """
    straight, bent = _places(camera)
    focal = _focal(camera)
    offset = np.array([camera.principal_point_x, camera.principal_point_y]) - [camera.width / 2, camera.height / 2]
    straight, bent = straight * focal + offset, bent * focal + offset
    half = max(camera.width, camera.height) / 2
    fit = _fitted(straight, bent, bent, count, half, np.ones(2))
    factor = 1.0 + _powers(bent / half, count) @ fit.coefficients
    away = np.linalg.norm(bent / factor[:, None] - straight, axis=1)
    return FittedModel(fit.coefficients, float(away.max()))


def _places(camera: pycolmap.Camera) -> tuple[Array, Array]:
    """(n, 2) undistorted and distorted places over the image, from the principal point, in focal lengths."""
    x, y = np.meshgrid(np.linspace(0, camera.width, _ACROSS), np.linspace(0, camera.height, _DOWN))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    straight = np.asarray(camera.cam_from_img(pixels), np.float64)
    bent = (pixels - [camera.principal_point_x, camera.principal_point_y]) / _focal(camera)
    known = np.isfinite(straight).all(axis=1)
    if not known.all():
        raise InputError(
            f"the lens model {camera.model_name} cannot be inverted in {100 * (1 - known.mean()):.0f} % of the image; "
            "no other model can follow it there"
        )
    return straight, bent


def _focal(camera: pycolmap.Camera) -> Array:
    return np.array([camera.focal_length_x, camera.focal_length_y])


def _fitted(source: Array, target: Array, radius_of: Array, count: int, unit: float, pixels: Array) -> FittedModel:
    """``target = source * (1 + k1 r^2 + ...)`` by least squares; `pixels`: what 1 is in x and y."""
    columns = source[:, :, None] * _powers(radius_of / unit, count)[:, None, :]
    scaled = columns * pixels[:, None]
    wanted = (target - source) * pixels
    coefficients = np.linalg.lstsq(scaled.reshape(-1, count), wanted.ravel(), rcond=None)[0]
    away = np.linalg.norm(wanted - scaled @ coefficients, axis=1)
    return FittedModel(tuple(coefficients.tolist()), float(away.max()))


def _powers(places: Array, count: int) -> Array:
    """(n, count) even powers of the radius, from the second on."""
    square = (places**2).sum(axis=1)
    return np.asarray(square[:, None] ** np.arange(1, count + 1))
