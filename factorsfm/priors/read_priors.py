"""The priors of a frame, checked: a prior may be the user's own code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.depth_map import DepthKind
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.priors.masks import MaskPrior
from factorsfm.support.errors import FactorsfmError, InputError, ModelError

_LEAST_VALUES = 10  # valid keypoints, below which a depth map is not used


def read_mask(masks: MaskPrior | None, frame: Frame) -> NDArray[np.bool_] | None:
    """The mask of a frame, (h, w), True = ignore; None if there is none.

    Raises:
        InputError: the prior fails, or its mask has another size than the frame.
    """
    if masks is None:
        return None
    with reported_failure("mask", frame):
        mask = masks(frame)
    if mask is not None and mask.shape != frame.image.shape[:2]:
        raise InputError(
            f"the mask of frame {frame.index} has shape {mask.shape}, expected {frame.image.shape[:2]} as the frame"
        )
    return mask


def read_depth(depth: DepthPrior, frame: Frame, xy: NDArray[np.float64]) -> ImageDepth | None:
    """The depth prior at keypoints of a frame.

    Args:
        xy: (n, 2) pixels, centres at integers.

    Returns:
        The prior, or None if there is no map or fewer than 10 keypoints have a valid depth.

    Raises:
        InputError: the prior fails.
    """
    with reported_failure("depth", frame):
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
def reported_failure(what: str, frame: Frame) -> Iterator[None]:
    """Turn any exception of a prior into a `ModelError` that names the frame; errors of this package pass."""
    try:
        yield
    except FactorsfmError:
        raise
    except Exception as error:
        raise ModelError(f"the {what} prior failed on frame {frame.index}: {error!r}") from error
