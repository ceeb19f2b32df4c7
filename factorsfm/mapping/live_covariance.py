"""How certain a pose is when it is given, long before the shot has shown all that it will."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage, nearest_registered
from factorsfm.support.rotations import adjoint

Array = NDArray[np.float64]

_YOUNG_ERROR = 0.8  # relative, of a map that only the prior has shaped; falls with the square of the keyframes
_MOST_PLACES = 50  # with so many a map is not young
_SAME_PLACE = 0.02  # of the camera's displacement: keyframes nearer than that tell no more of the map's shape than one


def live_covariance(
    image: MappedImage, on_map: Array, images: Sequence[MappedImage], keyframes: Sequence[int]
) -> Array:
    """(6, 6) of a pose that was just registered (`FrameResult.covariance`).

    Args:
        on_map: (6, 6) what is uncertain where the map is exact.
        images: all; keyframes: positions of those whose covariance the graph may have given: what the map leaves open.
    """
    rotation, translation = image.pose
    on_map = on_map + doubt(image, images)
    solved = [images[k] for k in keyframes if images[k].covariance is not None]
    # What linearised covariances do not know of a young map: that its whole shape is still a guess.
    places = _places(solved, -rotation.T @ translation)
    bent = _YOUNG_ERROR * float(np.linalg.norm(translation)) / places**2
    on_map = on_map + bent**2 * np.eye(6)
    if len(solved) < 2:
        return on_map
    assert solved[-1].covariance is not None
    return on_map + carried(solved[-1].covariance, solved[-1].pose, image.pose)


def doubt(image: MappedImage, images: Sequence[MappedImage]) -> Array:
    """(6, 6) of the pose of a rough image: as far as it is from the image beside it, in any direction; of others none.

    That it is a keyframe makes it no more certain: what bends its pose is in the graph then.
    """
    if not image.rough:
        return np.zeros((6, 6))
    beside = nearest_registered(images, image.tracks.position).pose
    turn = image.pose[0] @ beside[0].T
    far = np.linalg.norm(cv2.Rodrigues(turn)[0]), np.linalg.norm(image.pose[1] - turn @ beside[1])
    return np.diag(np.repeat(np.square(far), 3))


def window_covariance(pose: tuple[Array, Array], given: Array, constant: Sequence[MappedImage]) -> Array:
    """(6, 6) of a keyframe's pose, the uncertainty of the constant keyframes included.

    The errors of constant keyframes are nearly the same, so that all that hangs on them moves with them as one body.

    Args:
        pose: rotation (3, 3) and translation (3,), cam_from_world.
        given: (6, 6) what is uncertain where the constant keyframes are exact.
        constant: keyframes that the graph holds; the first of a map, which is the world, is without error.
    """
    held = [carried(image.covariance, image.pose, pose) for image in constant if image.covariance is not None]
    return given + np.sum(held, axis=0) / len(constant) if held else given


def carried(covariance: Array, origin: tuple[Array, Array], pose: tuple[Array, Array]) -> Array:
    """(6, 6) of what is uncertain in the pose `origin`, in the camera of another pose that moves with it."""
    turn = pose[0] @ origin[0].T
    through = adjoint(turn, pose[1] - turn @ origin[1])
    return np.asarray(through @ covariance @ through.T)


def _places(keyframes: Sequence[MappedImage], center: Array) -> int:
    """From how many places keyframes have seen the scene, on the scale of the move to `center`; at least 1."""
    recent = (image.pose for image in keyframes[-_MOST_PLACES:])
    centers = np.array([-rotation.T @ translation for rotation, translation in recent])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1) if len(centers) > 1 else np.zeros(0)
    return 1 + int((steps > _SAME_PLACE * np.linalg.norm(center)).sum())
