"""The objects of a result: solved beside the finished scene, and written and read as objects.json."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from factorsfm.frames.frame import Frame
from factorsfm.objects.moving import MovingThings, moving_things
from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.objects.observed import ObservedObjects, RememberedDepth
from factorsfm.objects.scale import PriorOnScene, ScaleSource
from factorsfm.objects.solve import SceneCamera, solve_object
from factorsfm.priors.depth import DepthPrior
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.json_reading import read_json, typed
from factorsfm.support.options import Options
from factorsfm.tracks.image_tracks import ImageTracks

logger = logging.getLogger(__name__)


def add_objects(result: Reconstruction, observed: ObservedObjects, options: Options) -> None:
    """Solve the objects that were seen beside a finished scene; notes say of each how its scale is known, or why it is
    not solved."""
    lenses = {position: result.camera_of(frame) for position, frame in enumerate(result.frames) if frame.registered}
    cameras = _scene_cameras(result, observed.depth_on_things)
    solved = []
    for name in observed.names:
        try:
            found = solve_object(name, observed.tracks(name, lenses), observed.colors(name), cameras, options)
        except ReconstructionError as error:
            logger.info("object %s: %s", name, error)
            result.notes.append(f"The object {name} is not solved: {error}.")
            continue
        solved.append(found)
        result.notes.append(
            f"The object {name} is solved in {len(found.frames)} frames, its rotation known to "
            f"{found.rotation_std:.2g} degrees (one standard deviation). {found.note}"
        )
    result.objects = tuple(solved)


@contextmanager
def seen_again(
    result: Reconstruction,
    images: Sequence[ImageTracks],
    frames: Iterable[Frame],
    depth: DepthPrior | None,
    options: Options,
) -> Iterator[ObservedObjects]:
    """The things that move by themselves beside a finished scene, as they are followed in its frames read once more.

    Their tracks among those of the scene tell where they are. To solve them, they need more, and none that see what is
    behind them.

    Args:
        images: what the scene was solved from, an image for each frame of the result.
        frames: of the source; depth: the prior of the scene.
    """
    shown = [(position, frame) for position, frame in enumerate(result.frames) if frame.cam_from_world is not None]
    seen = [
        replace(images[position], position=position, index=frame.index, camera=result.camera_of(frame))
        for position, frame in shown
    ]
    seen = [image.of(image.invertible) for image in seen]
    poses = {position: frame.cam_from_world for position, frame in shown if frame.cam_from_world is not None}
    things = moving_things(seen, poses, result.track_ids, options)
    result.notes.append(_said(things))
    remembered = RememberedDepth(depth) if depth is not None else None
    of_scene = {frame.index: frame for frame in result.frames}
    with ObservedObjects(things, None, remembered, options.tracker) as observed:
        for frame in frames if things.places else ():
            if frame.index not in of_scene:
                continue
            observed(frame)
            if remembered is not None and of_scene[frame.index].prior is not None:
                remembered(frame)
            observed.push(frame)
        yield observed


def _said(things: MovingThings) -> str:
    """What moves by itself, as a sentence."""
    if not things.places and not things.loose:
        return "Nothing moves by itself beside the scene."
    large = "; ".join(things.described()) or "none is large enough, and seen for long enough, to be solved"
    return f"Things that move by themselves: {large}. Tracks that belong to none of them: {things.loose}."


def _scene_cameras(result: Reconstruction, on_things: float) -> dict[int, SceneCamera]:
    """The registered frames by position; `on_things`: as in `PriorOnScene`."""
    cameras = {}
    everywhere = float(np.median(np.linalg.norm(result.points, axis=1))) if len(result.points) else 1.0
    order = np.argsort(result.observation_frame, kind="stable")
    first = np.searchsorted(result.observation_frame[order], np.arange(len(result.frames) + 1))
    for position, frame in enumerate(result.frames):
        if frame.cam_from_world is None:
            continue
        seen = result.points[result.observation_point[order[first[position] : first[position + 1]]]]
        depth = float(np.median((frame.cam_from_world * seen)[:, 2])) if len(seen) else everywhere
        prior = None
        if (fit := frame.prior) is not None:
            prior = PriorOnScene(fit.scale, fit.shift, fit.scale_std, fit.shift_std, fit.sigma, fit.smooth, on_things)
        cameras[position] = SceneCamera(frame.index, frame.cam_from_world, depth, prior)
    return cameras


# --- objects.json -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Frame:
    index: int
    translation: list[float]
    rotation: list[float]
    covariance: list[list[float]]


@dataclass(frozen=True, slots=True)
class _Object:
    name: str
    scale_std: float | None
    scale_from: ScaleSource | None
    reprojection_error: float
    note: str
    frames: list[_Frame]
    points: list[list[float]]
    colors: list[list[int]]


@dataclass(frozen=True, slots=True)
class _Objects:
    objects: list[_Object]


def objects_json(objects: Sequence[ObjectResult]) -> dict[str, Any]:
    """The content of objects.json: `ObjectResult`, poses as ``translation`` (x, y, z) and ``rotation`` (quaternion
    x, y, z, w) of world_from_object."""
    return asdict(_Objects([_plain(found) for found in objects]))


def _plain(found: ObjectResult) -> _Object:
    return _Object(
        found.name,
        found.scale_std,
        found.scale_from,
        found.reprojection_error,
        found.note,
        [
            _Frame(
                frame.index,
                frame.world_from_object.translation.tolist(),
                frame.world_from_object.rotation.quat.tolist(),
                frame.covariance.tolist(),
            )
            for frame in found.frames
        ],
        found.points.tolist(),
        found.colors.tolist(),
    )


def read_objects(path: Path) -> tuple[ObjectResult, ...]:
    """The objects of an objects.json; none where there is no file.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return ()
    content = typed(_Objects, read_json(path, "the objects"), "objects.json")
    return tuple(_object(plain) for plain in content.objects)


def _object(plain: _Object) -> ObjectResult:
    return ObjectResult(
        name=plain.name,
        frames=tuple(
            ObjectFrame(
                frame.index,
                pycolmap.Rigid3d(
                    pycolmap.Rotation3d(_array(frame.rotation, (4,), plain.name)),
                    _array(frame.translation, (3,), plain.name),
                ),
                _array(frame.covariance, (6, 6), plain.name),
            )
            for frame in plain.frames
        ),
        points=_array(plain.points, (len(plain.points), 3), plain.name),
        colors=_array(plain.colors, (len(plain.points), 3), plain.name).astype(np.uint8),
        reprojection_error=plain.reprojection_error,
        scale_std=plain.scale_std,
        scale_from=plain.scale_from,
        note=plain.note,
    )


def _array(values: list[Any], shape: tuple[int, ...], name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        array = np.array(values, np.float64)
    except ValueError:
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"objects.json: the object {name} has a row of numbers that is none of {shape}")
    return array
