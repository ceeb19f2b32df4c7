"""Depth priors that know nothing of the scene; a method that weighs its prior must not be harmed by them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth_map import DepthKind, DepthMap

_SHAPE = (96, 160)  # of the maps, pixels
_CORRELATION_LENGTH = 0.25  # of the random field, as a share of its width
_LOG_SIGMA = 0.5  # standard deviation of the logarithm of the random field


def image_row_depth(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Inverse depth (h, w) that grows linearly from 1 / h in the top row to 1 in the bottom row."""
    height, width = shape
    rows = np.arange(1, height + 1, dtype=np.float32) / np.float32(height)
    return np.repeat(rows[:, None], width, axis=1)


def random_smooth_depth(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """A random positive field (h, w): the exponential of noise that is smooth over a quarter of the width."""
    height, width = shape
    sigma = _CORRELATION_LENGTH * width / 2.0
    pad = int(np.ceil(3 * sigma))
    white = rng.standard_normal((height + 2 * pad, width + 2 * pad))
    field = cv2.GaussianBlur(white, (0, 0), sigma)[pad : pad + height, pad : pad + width]
    # Blurred white noise has the variance 1 / (4 pi sigma^2).
    return np.asarray(np.exp(_LOG_SIGMA * 2.0 * np.sqrt(np.pi) * sigma * field), np.float32)


class ImageRowPrior:
    """The image row as inverse depth (`image_row_depth`), equal in all frames."""

    kind = DepthKind.INVERSE
    name = "image row"

    def __call__(self, frame: Frame) -> DepthMap:
        return DepthMap(image_row_depth(_SHAPE), self.kind)


class RandomSmoothPrior:
    """A random smooth field (`random_smooth_depth`) for every frame, which the seed and the frame index determine."""

    kind = DepthKind.INVERSE
    name = "random field"

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed

    def __call__(self, frame: Frame) -> DepthMap:
        rng = np.random.default_rng([self._seed, frame.index])
        return DepthMap(random_smooth_depth(_SHAPE, rng), self.kind)
