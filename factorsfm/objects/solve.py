"""An object solved: its motion relative to the camera, and by that of the camera its motion in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.objects.growth import grown
from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.objects.rest import Sighting, scale_at_rest
from factorsfm.objects.scale import PriorOnScene, Scale, scale_from_prior
from factorsfm.objects.smooth_errors import smooth_error_covariance
from factorsfm.objects.start import LEAST_FRAMES, LEAST_TRACKS, object_start
from factorsfm.polish.polish import polish
from factorsfm.polish.polished import Polished
from factorsfm.polish.shot import Shot
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options
from factorsfm.support.rotations import adjoint
from factorsfm.support.similarity import covariance_in_unit
from factorsfm.support.status import ShotKind
from factorsfm.tracks.image_tracks import ImageTracks, seen_by

Array = NDArray[np.float64]

# On rendered boxes: with 5.6 pixels of perspective and more all starts are right, by margins of 31 and more. With up to
# 4.7, one in three is wrong, by margins of up to 77.
_LEAST_PERSPECTIVE_PX, _LEAST_MARGIN = 5.2, 25.0
# Degrees. With 0.9 the path of rendered boxes is right to 1 %; with 1.5 wrong by 7 %, and the rotation by 30 degrees.
_LARGEST_ROTATION_STD = 1.2
# Of the tracks on it. One figure with motion blur has 0.98 and more, two that walk in opposite directions 0.5.
_RIGID_SHARE, _EXPLAINED_PX = 0.8, 1.0
_TOO_FAR = 0.3  # inverse distance over the median: nothing of a thing is three times as far away as the rest


@dataclass(frozen=True, slots=True)
class SceneCamera:
    """A frame of the scene.

    Attributes:
        index: of the frame in its source; cam_from_world: its pose.
        median_depth: of the scene's points that it sees, units of the world.
        prior: of its depth map, None without one that took part.
    """

    index: int
    cam_from_world: pycolmap.Rigid3d
    median_depth: float
    prior: PriorOnScene | None


def solve_object(
    name: str,
    images: Sequence[ImageTracks],
    colors: NDArray[np.uint8],
    cameras: Mapping[int, SceneCamera],
    options: Options,
) -> ObjectResult:
    """Solve for a rigid thing.

    Args:
        name: of the object; images: its tracks, with the cameras of the solved scene, by time.
        colors: (k, 3) RGB by track id; cameras: of the scene, by position of the image.

    Raises:
        ReconstructionError: it cannot be solved; the message says why.
    """
    images = [image for image in images if image.position in cameras and len(image.ids) >= LEAST_TRACKS]
    if len(images) < LEAST_FRAMES:
        raise ReconstructionError(
            f"{len(images)} frames have {LEAST_TRACKS} tracks on it, at least {LEAST_FRAMES} needed"
        )
    turns = np.array([cameras[image.position].cam_from_world.rotation.matrix() for image in images])
    start = object_start(images, turns, options.polish)
    if start is None:
        raise ReconstructionError(f"no three frames share {LEAST_TRACKS} tracks on it")
    if start.perspective < _LEAST_PERSPECTIVE_PX:
        raise ReconstructionError(
            f"it is too small in the image: perspective changes its size by {start.perspective:.1f} pixels, "
            f"{_LEAST_PERSPECTIVE_PX} needed to tell which way it turns"
        )
    if start.margin < _LEAST_MARGIN:
        raise ReconstructionError(
            f"two motions explain its {len(start.ids)} longest tracks almost equally well (log-likelihoods differ by "
            f"{start.margin:.0f}, {_LEAST_MARGIN:.0f} needed)"
        )
    mapped, ids, points = grown(start, images, options)
    focal = np.array([image.camera.mean_focal_length() for image in images])
    zooms = bool(np.ptp(focal) > 0.0)
    shot = Shot.of(
        mapped, (ids, points), focal if zooms else focal[:1], groups=np.arange(len(images)) if zooms else None
    )
    polished = polish(shot, replace(options, lens="fixed"))
    if polished.motion.kind is not ShotKind.GENERAL:
        raise ReconstructionError("it shows too little perspective: its distance and its turning cannot be told apart")
    _check_rigid(polished, mapped, options)
    found = _result(name, polished, images, colors, cameras)
    if (std := found.rotation_std) > _LARGEST_ROTATION_STD:
        raise ReconstructionError(
            f"it is too small, or turns too little: its rotation would be known to {std:.1f} degrees at best, "
            f"{_LARGEST_ROTATION_STD} needed"
        )
    return found


def _check_rigid(polished: Polished, mapped: Sequence[MappedImage], options: Options) -> None:
    """Raise a ReconstructionError where one rigid motion does not explain most tracks."""
    least = min(options.polish.min_track_length, len(polished.frames))
    tracks = len(seen_by([image.tracks for image in mapped if image.registered], least))
    typical = np.sqrt(polished.observations.mean_by_point(polished.errors**2))
    explained = int(((typical < _EXPLAINED_PX) & _on_object(polished)).sum())
    if explained < _RIGID_SHARE * tracks:
        raise ReconstructionError(f"it is not rigid: one motion explains {explained} of {tracks} tracks on it")


def _on_object(polished: Polished) -> NDArray[np.bool_]:
    """(n,) which points are not beyond what a thing may be deep."""
    inverse = polished.state.inverse_distance
    return np.asarray(inverse > _TOO_FAR * np.median(inverse))


def _result(
    name: str,
    polished: Polished,
    images: Sequence[ImageTracks],
    colors: NDArray[np.uint8],
    cameras: Mapping[int, SceneCamera],
) -> ObjectResult:
    """In the world of the scene; the polish is in that of the object's first camera."""
    state = polished.state
    good = _on_object(polished)
    points = state.points[good]
    seen = [cameras[images[row].position] for row in polished.frames]
    first = seen[0].cam_from_world.rotation.matrix()
    origin = points.mean(0)
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation @ first), rotation @ origin + translation)
        for rotation, translation in zip(state.rotation, state.translation, strict=True)
    ]  # cam_from_object, in units of the object
    # `object_from_cam`, perturbed on the right, is seen from the other side.
    inverse = [pose.inverse() for pose in poses]
    carried = np.array([adjoint(pose.rotation.matrix(), pose.translation) for pose in inverse])
    covariance = polished.covariance + smooth_error_covariance(polished, images[0].camera.width)
    covariance = carried @ covariance @ carried.transpose(0, 2, 1)
    scale = scale_at_rest(_sighting(poses, covariance, seen)) or _scale(polished, images, seen)
    size = scale.value if scale is not None else seen[0].median_depth / float(points[:, 2].mean())
    frames = []
    for pose, uncertain, camera in zip(poses, covariance, seen, strict=True):
        cam_from_object = pycolmap.Rigid3d(pose.rotation, size * pose.translation)
        world_from_object = camera.cam_from_world.inverse() * cam_from_object
        frames.append(ObjectFrame(camera.index, world_from_object, covariance_in_unit(uncertain, size)))
    return ObjectResult(
        name=name,
        frames=tuple(frames),
        points=size * (points - origin) @ first,
        colors=colors[polished.tracks[good]],
        reprojection_error=float(np.median(polished.errors)),
        scale_std=None if scale is None else scale.std,
        scale_from=None if scale is None else scale.source,
        note=_note(scale),
    )


def _sighting(cam_from_object: Sequence[pycolmap.Rigid3d], covariance: Array, seen: Sequence[SceneCamera]) -> Sighting:
    world_from_cam = [camera.cam_from_world.inverse() for camera in seen]
    pairs = list(zip(world_from_cam, cam_from_object, strict=True))
    return Sighting(
        np.array([(world.rotation * pose.rotation).matrix() for world, pose in pairs]),
        np.array([world.translation for world in world_from_cam]),
        np.array([world.rotation * pose.translation for world, pose in pairs]),
        covariance,
    )


def _scale(polished: Polished, images: Sequence[ImageTracks], seen: Sequence[SceneCamera]) -> Scale | None:
    state, o = polished.state, polished.observations
    depths = state.camera_points(o.frame, o.point)[:, 2] / state.inverse_distance[o.point]
    maps = []
    for k, row in enumerate(polished.frames):
        depth, prior = images[row].depth, seen[k].prior
        if depth is None or prior is None:
            continue
        mine = o.frame == k
        at = np.searchsorted(images[row].ids, polished.tracks[o.point[mine]])
        valid = depth.valid[at]
        maps.append((depth.inverse_depth[at][valid] * depth.unit, depths[mine][valid], prior))
    return scale_from_prior(maps)


def _note(scale: Scale | None) -> str:
    if scale is None:
        return (
            "Nothing gives its scale: it is put at the scene's median depth, and its size and path are known up to "
            "their distance from the camera."
        )
    if scale.source == "rest":
        return (
            f"It rests in the scene for {scale.frames} frames, and its scale is that of the scene: "
            f"± {100 * scale.std:.1g} %."
        )
    return f"Its scale comes from the depth prior on it ({scale.frames} maps): ± {100 * scale.std:.0f} %."
