"""tracks.npz of a result folder: the shot as it was measured, from which it can be solved again.

Arrays of NumPy, compressed, and "facts", a JSON text; docs/mending.md describes them.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import camera_from_json, camera_to_json
from factorsfm.control.files import control_of
from factorsfm.frames.recorded import RecordedFootage, RecordedFrame
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.measured import MeasuredShot
from factorsfm.priors.depth_map import DepthKind
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import typed
from factorsfm.support.json_text import json_text
from factorsfm.support.options import Options
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks
from factorsfm.tracks.supervised import SupervisedTracks

Arrays = Mapping[str, NDArray[Any]]

_FORMAT = 1
# Name, type and shape of the arrays: f frames, m observations, n points of the map, t tracks, s suspects.
_ARRAYS = {
    "frame_start": ("<i8", ("f+1",)),
    "track": ("<i4", ("m",)),
    "xy": ("<f4", ("m", 2)),
    "inverse_depth": ("<f4", ("m",)),
    "depth_unit": ("<f8", ("f",)),
    "cam_from_map": ("<f8", ("f", 3, 4)),
    "point_track": ("<i4", ("n",)),
    "point": ("<f8", ("n", 3)),
    "color_track": ("<i4", ("t",)),
    "color": ("|u1", ("t", 3)),
    "suspect": ("<i4", ("s",)),
}
_ASCENDING = ("point_track", "color_track", "suspect")


@dataclass(frozen=True, slots=True)
class _Frame:
    index: int
    name: str
    timestamp: float | None
    status: FrameStatus
    message: str
    keyframe: bool


@dataclass(frozen=True, slots=True)
class _Supervised:
    track: int
    name: str
    sigma: float


@dataclass(frozen=True, slots=True)
class _Facts:
    """What is no array."""

    format: int
    frames: list[_Frame]
    footage: RecordedFootage
    camera: dict[str, Any]
    lens_given: bool
    first_focal: list[float]
    depth_kind: DepthKind | None
    free_shift: bool
    supervised: list[_Supervised]
    options: dict[str, Any]
    control: dict[str, Any] | None
    notes: list[str]
    supervised_join: bool = False


def write_tracks(measured: MeasuredShot, path: Path) -> None:
    """Write the file: places to a thousandth of a pixel, depths to six digits."""
    tracks = [image.tracks for image in measured.images]
    depths = [image.depth for image in tracks]
    ids = np.concatenate([image.ids for image in tracks])
    seen = np.unique(ids)
    known = measured.supervised
    facts = _Facts(
        format=_FORMAT,
        frames=[
            _Frame(frame.index, frame.name, frame.timestamp, image.status, image.message, image.keyframe)
            for frame, image in zip(measured.frames, measured.images, strict=True)
        ],
        footage=measured.footage,
        camera=camera_to_json(measured.camera),
        lens_given=measured.lens_given,
        first_focal=list(measured.first_focal),
        depth_kind=measured.depth_kind,
        free_shift=all(depth.free_shift for depth in depths if depth is not None),
        supervised=[_Supervised(*one) for one in zip(known.ids.tolist(), known.names, known.sigma, strict=True)],
        options=measured.options.to_dict(),
        control=None if measured.control is None else asdict(measured.control),
        notes=list(measured.notes),
        supervised_join=known.join,
    )
    arrays = {
        "frame_start": np.cumsum([0, *(len(image.ids) for image in tracks)]),
        "track": ids,
        "xy": np.concatenate([image.pixels for image in tracks]),
        "inverse_depth": np.concatenate([_usable_depth(image) for image in tracks]),
        "depth_unit": np.array([np.nan if depth is None else depth.unit for depth in depths]),
        "cam_from_map": np.array([_matrix(image) for image in measured.images]),
        "point_track": measured.map_points[0],
        "point": measured.map_points[1],
        "color_track": seen,
        "color": measured.colors[seen],
        "suspect": measured.suspects,
    }
    stored = {name: np.asarray(arrays[name]).astype(dtype) for name, (dtype, _) in _ARRAYS.items()}
    with path.open("wb") as file:
        np.savez_compressed(file, facts=np.array(json_text(asdict(facts), indent=None)), **stored)  # type: ignore[arg-type]


def _usable_depth(image: ImageTracks) -> NDArray[np.float64]:
    """(n,) inverse depths where the prior is used, NaN elsewhere."""
    depth = image.depth
    return np.full(len(image.ids), np.nan) if depth is None else np.where(depth.valid, depth.inverse_depth, np.nan)


def _matrix(image: MappedImage) -> NDArray[np.float64]:
    if not image.registered:
        return np.full((3, 4), np.nan)
    rotation, translation = image.pose
    return np.column_stack([rotation, translation])


def read_tracks(path: Path) -> MeasuredShot | None:
    """The shot as it was measured; None where there is no file.

    Raises:
        InputError: the file is damaged, or of another version.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as content:
            facts = typed(_Facts, json.loads(str(content["facts"])), "facts")
            arrays = {name: content[name] for name in _ARRAYS}
        if facts.format != _FORMAT:
            raise InputError(f"its format is {facts.format}, and this version reads {_FORMAT}")
        _check(facts, arrays)
        return _measured(facts, arrays)
    except (OSError, ValueError, LookupError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, InputError) as error:
        raise InputError(f"{path.name} is damaged: {error}") from error


def _check(facts: _Facts, arrays: Arrays) -> None:
    """The shapes and types of the arrays, and that they fit together."""
    sizes = {"f": len(facts.frames), "f+1": len(facts.frames) + 1}
    for name, (dtype, shape) in _ARRAYS.items():
        array = arrays[name]
        expected = tuple(
            sizes.setdefault(size, length) if isinstance(size, str) else size
            for size, length in zip(shape, array.shape, strict=False)  # of other dimensions, they differ
        )
        if array.dtype != np.dtype(dtype) or array.shape != expected:
            raise InputError(f"{name} is {array.dtype} of shape {array.shape}; {dtype} of shape {expected} is expected")
    start, track = arrays["frame_start"], arrays["track"]
    if start[0] != 0 or start[-1] != len(track) or (np.diff(start) < 0).any():
        raise InputError("frame_start does not divide the observations")
    within = np.ones(max(len(track) - 1, 0), bool)
    within[start[1:-1][(start[1:-1] > 0) & (start[1:-1] < len(track))] - 1] = False
    for name, rises in (("track", np.diff(track)[within]), *((n, np.diff(arrays[n])) for n in _ASCENDING)):
        if (rises <= 0).any() or (len(arrays[name]) and arrays[name].min() < 0):
            raise InputError(f"{name} does not ascend from 0")
    if not (np.isfinite(arrays["xy"]).all() and np.isfinite(arrays["point"]).all()):
        raise InputError("a place is not finite")
    if not np.isin(track, arrays["color_track"]).all():
        raise InputError("a track has no colour")


def _measured(facts: _Facts, arrays: Arrays) -> MeasuredShot:
    camera = camera_from_json(facts.camera)
    colors = np.zeros((int(arrays["color_track"].max(initial=-1)) + 1, 3), np.uint8)
    colors[arrays["color_track"]] = arrays["color"]
    focal, std = facts.first_focal
    known = sorted(facts.supervised, key=lambda one: one.track)
    return MeasuredShot(
        frames=[RecordedFrame(frame.index, frame.name, frame.timestamp) for frame in facts.frames],
        footage=facts.footage,
        images=[_image(position, facts, arrays, camera) for position in range(len(facts.frames))],
        map_points=(arrays["point_track"].astype(np.int64), arrays["point"]),
        colors=colors,
        camera=camera,
        lens_given=facts.lens_given,
        first_focal=(focal, std),
        depth_kind=facts.depth_kind,
        suspects=arrays["suspect"].astype(np.int64),
        supervised=SupervisedTracks(
            np.array([one.track for one in known], np.int64),
            tuple(one.name for one in known),
            np.array([one.sigma for one in known]),
            facts.supervised_join,
        ),
        options=Options.from_dict(facts.options),
        control=None if facts.control is None else control_of(facts.control),
        notes=tuple(facts.notes),
    )


def _image(position: int, facts: _Facts, arrays: Arrays, camera: pycolmap.Camera) -> MappedImage:
    frame, rows = facts.frames[position], slice(*arrays["frame_start"][position : position + 2].tolist())
    unit, depth = float(arrays["depth_unit"][position]), None
    if np.isfinite(unit):
        values = arrays["inverse_depth"][rows].astype(np.float64)
        depth = ImageDepth(values, np.ones(len(values)), unit, facts.free_shift)
    tracks = ImageTracks(
        position,
        arrays["track"][rows].astype(np.int64),
        arrays["xy"][rows].astype(np.float64),
        camera,
        depth,
        frame.index,
    )
    pose = arrays["cam_from_map"][position]
    image = MappedImage(tracks, frame.status, frame.message, keyframe=frame.keyframe)
    if np.isfinite(pose).all():
        image.rotation, image.translation = pose[:, :3].copy(), pose[:, 3].copy()
    return image
