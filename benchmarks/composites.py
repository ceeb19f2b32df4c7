"""Shots with something large that moves by itself: textured figures laid into shots of which the truth is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm import Frame

Array = NDArray[np.float32]
Track = Callable[[float], tuple[float, float, float]]

_BLUR_STEPS = 4  # places of a figure within the time that the shutter is open ...
_OPEN = 0.5  # ... which is this share of a frame


@dataclass(frozen=True, slots=True)
class Figure:
    """A rounded body with a head.

    Attributes:
        height: of the image's height, as the path begins.
        path: gives its centre (in widths and heights of the image) and how many times as tall as at first it is, at a
            share of the shot's time.
        sway: by how much its halves turn against each other and back, radians: a walker is not rigid.
    """

    height: float
    path: Track
    sway: float = 0.0


def crossing(start: float, end: float, y: float = 0.6, *, late: float = 0.0, stands: float = 0.0) -> Track:
    """A walk through the image, after a while outside of it or at rest at its start."""

    def path(time: float) -> tuple[float, float, float]:
        if time < late:
            return -9.0, y, 1.0
        walked = max(0.0, time - late - stands) / (1.0 - late - stands)
        return start + (end - start) * walked, y + 0.008 * abs(np.sin(40.0 * walked)), 1.0

    return path


def resting(x: float, y: float, *, by: float) -> Track:
    """At one place of the image, as in front of a camera that follows, but for slow moves."""
    return lambda time: (x + by * np.sin(9.0 * time), y + 0.4 * by * np.sin(14.0 * time + 1.0), 1.0)


KINDS: dict[str, tuple[Figure, ...]] = {
    "small, fast": (Figure(0.6, crossing(-0.1, 1.3), 0.10),),
    "large, slow": (Figure(1.0, crossing(0.15, 0.7), 0.06),),
    "enters late": (Figure(0.9, crossing(-0.2, 0.9, late=0.35), 0.06),),
    "stands, then walks": (Figure(0.8, crossing(0.3, 0.95, stands=0.4), 0.06),),
    "rests before the camera": (Figure(1.2, resting(0.2, 0.75, by=0.01), 0.02),),
    "fills half": (Figure(2.4, resting(0.32, 0.75, by=0.06), 0.03),),
    "two leave 40 %": (Figure(1.6, crossing(0.05, 0.4), 0.05), Figure(1.6, crossing(1.0, 0.6), 0.05)),
    "fills most": (Figure(3.6, resting(0.5, 0.9, by=0.06), 0.03),),
}


def composite(
    frames: list[Frame], figures: tuple[Figure, ...], textures: list[NDArray[np.uint8]]
) -> Iterator[tuple[Frame, Array]]:
    """The frames with figures before them, and how much of each pixel they cover, (h, w) from 0 to 1.

    Args:
        textures: images of other scenes, one for each figure.
    """
    for k, frame in enumerate(frames):
        image = frame.image.astype(np.float32)
        cover = np.zeros(image.shape[:2], np.float32)
        for figure, texture in zip(figures, textures, strict=False):
            times = (k + _OPEN * np.arange(_BLUR_STEPS) / _BLUR_STEPS) / len(frames)
            layers = [_drawn(figure, texture, float(time), cover.shape) for time in times]
            alpha, colour = (np.mean(parts, axis=0) for parts in zip(*layers, strict=True))
            image = image * (1.0 - alpha[..., None]) + colour
            cover = 1.0 - (1.0 - cover) * (1.0 - alpha)
        yield replace(frame, image=np.clip(np.round(image), 0, 255).astype(np.uint8)), cover


def _drawn(figure: Figure, texture: NDArray[np.uint8], time: float, shape: tuple[int, int]) -> tuple[Array, Array]:
    """How much a figure covers of each pixel, and its colour times that."""
    h, w = shape
    x, y, growth = figure.path(time)
    size = figure.height * growth * h
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    u, v = (u - x * w) / size, (v - y * h) / size
    turn = figure.sway * np.sin(50.0 * time) * np.tanh(4.0 * v)  # the upper half against the lower one
    u, v = u - turn * v, v + turn * u
    body = 1.0 - np.sqrt((u / 0.22) ** 2 + ((v - 0.12) / 0.38) ** 2)
    head = 1.0 - np.sqrt(u**2 + (v + 0.36) ** 2) / 0.12
    inside = np.maximum(0.22 * body, 0.12 * head) * size
    alpha = np.clip(inside + 0.5, 0.0, 1.0).astype(np.float32)
    pixels = (figure.height * h * (np.stack([u, v]) + 0.5)).astype(np.float32)  # of the texture, as it is at first
    colour = cv2.remap(texture, *pixels, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return alpha, alpha[..., None] * colour
