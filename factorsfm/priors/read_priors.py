"""What the priors say of a frame, checked: a prior is foreign code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthKind, DepthPrior
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.priors.masks import MaskPrior
from factorsfm.support.errors import FactorsfmError, InputError, ModelError

_LEAST_VALUES = 10


def read_mask(masks: MaskPrior | None, frame: Frame) -> NDArray[np.bool_] | None:
    """What to ignore in a frame, True = ignore; None without a mask.

    Raises:
        InputError: the prior fails, or its mask has another size than the frame.
    """
    if masks is None:
        return None
    with _failure_named("mask", frame):
        mask = masks(frame)
    if mask is not None and mask.shape != frame.image.shape[:2]:
        raise InputError(
            f"the mask of frame {frame.index} has shape {mask.shape}, expected {frame.image.shape[:2]} as the frame"
        )
    return mask


def read_depth(depth: DepthPrior, frame: Frame, xy: NDArray[np.float64]) -> ImageDepth | None:
    """The prior at keypoints (n, 2) of a frame, pixels; None where there is no map, or too little of it is valid.

    Raises:
        InputError: the prior fails.
    """
    with _failure_named("depth", frame):
        depth_map = depth(frame)
    if depth_map is None:
        return None
    inverse, reliability = depth_map.inverse_depth(xy, (frame.image.shape[1], frame.image.shape[0]))
    valid = np.isfinite(inverse) & (inverse > 0.0)
    if valid.sum() < _LEAST_VALUES:
        return None
    unit = float(np.median(inverse[valid]))
    return ImageDepth(inverse / unit, reliability, unit, depth.kind is DepthKind.INVERSE)


@contextmanager
def _failure_named(what: str, frame: Frame) -> Iterator[None]:
    """Whatever a prior raises becomes an error that names the frame."""
    try:
        yield
    except FactorsfmError:
        raise
    except Exception as error:
        raise ModelError(f"the {what} prior failed on frame {frame.index}: {error!r}") from error
