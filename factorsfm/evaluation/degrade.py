"""Degraded footage: blur, noise and compression, the same in every run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.support.errors import InputError


def degrade(
    image: NDArray[np.uint8],
    rng: np.random.Generator,
    blur: float = 1.0,
    noise: float = 8.0,
    jpeg_quality: int = 40,
) -> NDArray[np.uint8]:
    """Blur an image, add noise and compress it as JPEG, in this order.

    Args:
        image: (h, w, 3) BGR or (h, w) grey.
        rng: source of the noise.
        blur: standard deviation of the Gaussian blur, pixels; 0 for none.
        noise: standard deviation of the noise, grey levels.
        jpeg_quality: 1 to 100.

    Returns:
        The image, in the same shape.

    Raises:
        InputError: a negative blur or noise, or a quality outside 1 to 100.
    """
    if blur < 0 or noise < 0 or not 1 <= jpeg_quality <= 100:
        raise InputError(
            f"blur {blur} and noise {noise} must not be negative and JPEG quality {jpeg_quality} be 1 to 100"
        )
    soft = cv2.GaussianBlur(image, (0, 0), blur) if blur > 0 else image
    noisy = soft + noise * rng.standard_normal(image.shape)
    done, data = cv2.imencode(
        ".jpg", np.clip(np.rint(noisy), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    )
    if not done:
        raise InputError(f"an image of shape {image.shape} cannot be compressed as JPEG")
    flag = cv2.IMREAD_GRAYSCALE if image.ndim == 2 else cv2.IMREAD_COLOR
    return np.asarray(cv2.imdecode(data, flag), np.uint8)


def degraded_frames(
    frames: Iterable[Frame], seed: int = 0, blur: float = 1.0, noise: float = 8.0, jpeg_quality: int = 40
) -> Iterator[Frame]:
    """The frames, degraded by `degrade`; the noise depends on the seed and the frame's index only."""
    for frame in frames:
        rng = np.random.default_rng([seed, frame.index])
        yield replace(frame, image=degrade(frame.image, rng, blur, noise, jpeg_quality))
