"""A result in another world: turned, scaled and moved as a whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import Similarity, covariance_in_unit

Array = NDArray[np.float64]


def in_other_world(result: Reconstruction, world: Similarity) -> Reconstruction:
    """All of a result in another world: poses, points, objects, covariances, prior fits.

    Raises:
        InputError: the scene is not finite there.
    """
    old_from_new = pycolmap.Rigid3d(pycolmap.Rotation3d(world.rotation), world.translation).inverse()
    with np.errstate(over="ignore", invalid="ignore"):
        frames = [_frame(frame, world.scale, old_from_new) for frame in result.frames]
        points = world.points(result.points.reshape(-1, 3))
    translations = [frame.cam_from_world.translation for frame in frames if frame.cam_from_world is not None]
    if not (np.isfinite(points).all() and np.isfinite(translations).all()):
        raise InputError(f"the scene is not finite at scale {world.scale:g}")
    return replace(
        result,
        frames=frames,
        points=points,
        objects=tuple(_object(thing, world) for thing in result.objects),
        control=result.control and replace(result.control, position_std=world.scale * result.control.position_std),
        alignment=None,  # it is about the other world
        imu=result.imu and replace(result.imu, up=(world.rotation @ result.imu.up).tolist()),
    )


def _frame(frame: FrameResult, scale: float, old_from_new: pycolmap.Rigid3d) -> FrameResult:
    pose = frame.cam_from_world
    if pose is None:
        return frame
    unscaled = pycolmap.Rigid3d(pose.rotation, scale * pose.translation)  # world in the new unit, camera as well
    return replace(
        frame,
        cam_from_world=unscaled * old_from_new,
        covariance=_scaled(frame.covariance, scale),
        relative_covariance=_scaled(frame.relative_covariance, scale),
        prior=frame.prior
        and replace(frame.prior, scale=scale * frame.prior.scale, scale_std=scale * frame.prior.scale_std),
    )


def _scaled(covariance: Array | None, scale: float) -> Array | None:
    """A covariance of rotation and translation, in the axes of the camera, in another unit."""
    return None if covariance is None else covariance_in_unit(covariance, scale)


def _object(thing: ObjectResult, world: Similarity) -> ObjectResult:
    """An object's own axes are turned, too, so that they are those of the world at first."""
    turn = pycolmap.Rotation3d(world.rotation)
    carried = np.kron(np.diag([1.0, world.scale]), world.rotation)
    frames = []
    for frame in thing.frames:
        pose = frame.world_from_object
        place = world.points(np.asarray(pose.translation)[None])[0]
        turned = pycolmap.Rigid3d(turn * pose.rotation * turn.inverse(), place)
        frames.append(ObjectFrame(frame.index, turned, carried @ frame.covariance @ carried.T))
    return replace(thing, frames=tuple(frames), points=world.scale * thing.points @ world.rotation.T)
