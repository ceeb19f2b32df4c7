"""The reconstruction as one picture: from above, from the side, and the error of each frame."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.report.geometry import Scene, scene
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import verdict

_WIDTH, _HEIGHT = 1280, 720
_PAGE, _CARD, _LINE = (244, 246, 246), (255, 255, 255), (224, 226, 225)
_INK, _QUIET, _PATH, _CURVE = (33, 31, 29), (118, 111, 106), (15, 67, 209), (170, 105, 23)
_RAMP = np.array([(60, 205, 250), (70, 130, 240), (115, 75, 205), (165, 60, 125), (190, 90, 60)], float)
_SUBPIXEL = 4  # fractional bits of OpenCV's drawing coordinates
_OVERSAMPLING = 4  # of the dots, which OpenCV draws as crosses at their own size
_MAX_POINTS = 20_000


def draw_picture(reconstruction: Reconstruction) -> NDArray[np.uint8]:
    """(720, 1280, 3) BGR: camera path and points from above and from the side, errors frame by frame.

    Points are coloured by depth from the first camera: near yellow, far blue.
    """
    canvas = np.full((_HEIGHT, _WIDTH, 3), _PAGE, np.uint8)
    sentence = verdict(reconstruction)
    _text(canvas, sentence[0].upper() + sentence[1:], (24, 42), 0.62, _INK)
    view = scene(reconstruction, _MAX_POINTS)
    unit = "m" if reconstruction.metric else "units"
    top = _card(canvas, 24, 64, 608, 420, "From above")
    side = _card(canvas, 648, 64, 608, 420, "From the side")
    _draw_view(top, view, right=(1, 0, 0), down=(0, 0, -1), unit=unit)
    _draw_view(side, view, right=(0, 0, 1), down=(0, 1, 0), unit=unit)
    chart = _card(canvas, 24, 500, 1232, 196, "Reprojection error, median per frame (px)")
    _draw_errors(chart, reconstruction)
    return canvas


def _draw_view(
    image: NDArray[np.uint8],
    view: Scene,
    right: tuple[int, int, int],
    down: tuple[int, int, int],
    unit: str,
) -> None:
    """Orthographic view of the middle 96 % of the points and of the whole path."""
    if not len(view.points) or not len(view.centers):
        return
    axes = np.array([right, down], float)
    outline = np.vstack([np.percentile(view.points, [2, 98], axis=0), view.centers]) @ axes.T
    low, high = outline.min(axis=0), outline.max(axis=0)
    size = np.array(image.shape[1::-1], float)
    scale = 0.86 * (size / np.maximum(high - low, 1e-9)).min()

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points @ axes.T - (low + high) / 2) * scale + size / 2)

    order = np.argsort(-(view.points @ np.cross(right, down)))
    colors = _depth_colors(view.points[:, 2])
    large = cv2.resize(image, None, fx=_OVERSAMPLING, fy=_OVERSAMPLING, interpolation=cv2.INTER_NEAREST)
    for (u, v), color in zip(_OVERSAMPLING * project(view.points[order]), colors[order].tolist(), strict=True):
        if 0 <= u < large.shape[1] and 0 <= v < large.shape[0]:
            cv2.circle(large, (round(u), round(v)), round(1.4 * _OVERSAMPLING), color, -1)
    image[:] = cv2.resize(large, image.shape[1::-1], interpolation=cv2.INTER_AREA)
    path = project(view.centers)
    fixed = np.round(path * 2**_SUBPIXEL).astype(np.int32)
    cv2.polylines(image, [fixed], False, _PATH, 2, cv2.LINE_AA, _SUBPIXEL)
    cv2.circle(image, _fixed(*path[0]), 4 << _SUBPIXEL, _PATH, -1, cv2.LINE_AA, _SUBPIXEL)
    _draw_scale_bar(image, scale, unit)


def _draw_scale_bar(image: NDArray[np.uint8], scale: float, unit: str) -> None:
    length = _round_length(float(image.shape[1] / 6 / scale))
    x, y = 14, image.shape[0] - 14
    cv2.line(image, (x, y), (x + round(length * scale), y), _QUIET, 1, cv2.LINE_AA)
    if unit == "units" and length == 1:
        unit = "unit"
    _text(image, f"{length:g} {unit}", (x, y - 8), 0.42, _QUIET)


def _round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `most`."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= most * 1.0001)


def _draw_errors(image: NDArray[np.uint8], reconstruction: Reconstruction) -> None:
    errors = np.array([frame.reprojection_error for frame in reconstruction.frames])
    known = np.isfinite(errors)
    if not known.any():
        return
    left, right, top, bottom = 56, image.shape[1] - 20, 36, image.shape[0] - 28
    highest = max(1.1 * float(errors[known].max()), 1e-3)
    x = left + (right - left) * np.arange(len(errors)) / max(len(errors) - 1, 1)
    y = bottom - (bottom - top) * errors / highest
    for value in np.arange(0.0, highest, _round_length(highest / 2)):
        level = round(bottom - (bottom - top) * value / highest)
        cv2.line(image, (left, level), (right, level), _LINE, 1)
        _text(image, f"{value:.4g}", (14, level + 4), 0.4, _QUIET)
    for k in np.flatnonzero(known):
        if k + 1 < len(errors) and known[k + 1]:
            ends = _fixed(x[k], y[k]), _fixed(x[k + 1], y[k + 1])
            cv2.line(image, *ends, _CURVE, 2, cv2.LINE_AA, _SUBPIXEL)
        else:
            cv2.circle(image, _fixed(x[k], y[k]), 2 << _SUBPIXEL, _CURVE, -1, cv2.LINE_AA, _SUBPIXEL)
    frames = reconstruction.frames
    for tick in range(0, len(frames), max(1, round(_round_length(len(frames) / 4)))):
        _text(image, str(frames[tick].index), (round(x[tick]) - 8, bottom + 18), 0.4, _QUIET)


def _depth_colors(depth: NDArray[np.float64]) -> NDArray[np.int64]:
    """(n, 3) BGR, linear in inverse depth between the nearest and the farthest 3 %."""
    if not len(depth):
        return np.empty((0, 3), np.int64)
    nearest, farthest = np.percentile(depth, [3, 97])
    nearest = max(nearest, 1e-9)
    farthest = max(farthest, nearest * 1.01)
    inverse = 1 / np.maximum(depth, nearest)
    place = (1 / nearest - inverse) / (1 / nearest - 1 / farthest) * (len(_RAMP) - 1)
    channels = [np.interp(place, np.arange(len(_RAMP)), _RAMP[:, c]) for c in range(3)]
    return np.round(np.stack(channels, axis=1)).astype(np.int64)


def _card(canvas: NDArray[np.uint8], x: int, y: int, width: int, height: int, title: str) -> NDArray[np.uint8]:
    """A framed part of the canvas; drawing into it draws into the canvas."""
    cv2.rectangle(canvas, (x, y), (x + width - 1, y + height - 1), _CARD, -1)
    cv2.rectangle(canvas, (x, y), (x + width - 1, y + height - 1), _LINE, 1)
    _text(canvas, title, (x + 14, y + 24), 0.46, _QUIET)
    return canvas[y + 1 : y + height - 1, x + 1 : x + width - 1]


def _fixed(u: float, v: float) -> tuple[int, int]:
    return round(u * 2**_SUBPIXEL), round(v * 2**_SUBPIXEL)


def _text(image: NDArray[np.uint8], text: str, at: tuple[int, int], size: float, color: tuple[int, int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
