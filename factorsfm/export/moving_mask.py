"""Where something moves in a frame: around the tracks that move by themselves, and around solved objects."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.projection import pixels_from_normalized
from factorsfm.frames.frame import Frame
from factorsfm.priors.masks import DEFAULT_MARGIN, fitted
from factorsfm.result.reconstruction import FrameResult, Reconstruction

Array = NDArray[np.float64]

_WIDTH = 320  # pixels: an outline between tracks is no finer
# Share of the image's width around a track that moves which is taken for the thing, where no track at rest is nearer.
# Masks of rendered walkers cover 91 to 99 % of them so, 82 to 99 % with 0.05, and no more with 0.12.
_REACH = 0.08


def moving_mask(result: Reconstruction, frame: FrameResult, seen: Frame) -> NDArray[np.bool_]:
    """(h, w) in the size of the image, True where something moves: a track that moves is nearer than any at rest.

    Args:
        frame: registered; seen: its image.
    """
    height, width = seen.image.shape[:2]
    shape = (max(1, round(height * min(_WIDTH, width) / width)), min(_WIDTH, width))
    to_moving = _distance(_moving_places(result, frame), shape, width)
    to_rest = _distance(_resting_places(result, frame), shape, width)
    return fitted((to_moving <= to_rest) & (to_moving <= _REACH * shape[1]), seen, DEFAULT_MARGIN)


def _moving_places(result: Reconstruction, frame: FrameResult) -> Array:
    """(n, 2) pixels of what moves in a frame."""
    index = frame.index if frame.repeats is None else frame.repeats
    places = [np.empty((0, 2))]
    if result.moving is not None:
        places.append(result.moving.xy[result.moving.frame == index])
    assert frame.cam_from_world is not None
    for thing in result.objects:
        for at in thing.frames:
            if at.index == index:
                points = frame.cam_from_world * (at.world_from_object * thing.points)
                ahead = points[points[:, 2] > 0.0]
                places.append(pixels_from_normalized(result.camera_of(frame), ahead[:, :2] / ahead[:, 2:]))
    return np.concatenate(places)


def _resting_places(result: Reconstruction, frame: FrameResult) -> Array:
    """(n, 2) pixels at which points of the scene are seen in a frame."""
    index = frame.index if frame.repeats is None else frame.repeats
    position = next(k for k, other in enumerate(result.frames) if other.index == index)
    return np.asarray(result.observation_xy[result.observation_frame == position])


def _distance(places: Array, shape: tuple[int, int], width: int) -> NDArray[np.float32]:
    """(h, w) distance to the nearest of some places in an image of a width, on a smaller one."""
    far = np.ones(shape, np.uint8)
    x, y = np.floor((places[np.isfinite(places).all(axis=1)] + 0.5) * shape[1] / width).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    far[y[inside], x[inside]] = 0
    if far.all():
        return np.full(shape, np.inf, np.float32)
    return np.asarray(cv2.distanceTransform(far, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)
