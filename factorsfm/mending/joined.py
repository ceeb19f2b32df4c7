"""Tracks of the user join a measured shot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.mending.user_tracks import UserTracks
from factorsfm.polish.measured import MeasuredShot
from factorsfm.support.errors import InputError
from factorsfm.tracks.supervised import SupervisedTracks, track_name

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_GREY = 128  # of a point whose colour nobody has looked up
_BESIDE_PX = 5.0  # beyond the border: a tracker follows a corner out of the picture so far
_MOST_BESIDE = 0.25  # share of the places beyond that: a plane that a tracker extrapolates may leave the picture, too


def joined(measured: MeasuredShot, given: UserTracks, lenses: dict[int, pycolmap.Camera] | None = None) -> MeasuredShot:
    """The shot with tracks of the user, which are supervised; of frames that it does not have nothing is taken, and
    a note counts the tracks that have no other.

    Args:
        lenses: of the frames by their numbers, for tracks that lie on undistorted footage; None: that of all frames.

    Raises:
        InputError: no track has two frames of the shot, a lens has no place for one, they lie on undistorted footage
            and no lens is known, or they are of an image of another size.
    """
    _check_size(given, measured.camera)
    if given.on == "undistorted" and lenses is None and not measured.lens_given:
        raise InputError(f"{given.source}: tracks on undistorted footage need its lens; a camera is expected")
    position = {frame.index: k for k, frame in enumerate(measured.frames)}
    shared = [sum(frame in position for frame in track.frames.tolist()) for track in given.tracks]
    kept = [track for track, count in zip(given.tracks, shared, strict=True) if count]
    if max(shared) < 2:
        frames = np.concatenate([track.frames for track in given.tracks])
        raise InputError(
            f"{given.source}: no track has two frames of the shot; its frames are {min(position)} to {max(position)}, "
            f"those of the tracks {frames.min()} to {frames.max()}; the number of the source's first frame in their "
            "file is expected (--tracks-first-frame)"
        )
    first = 1 + max((int(image.tracks.ids[-1]) for image in measured.images if len(image.tracks.ids)), default=-1)
    ids = first + np.arange(len(kept))
    seen: dict[int, list[tuple[int, Array]]] = {}
    for track, own in zip(kept, ids.tolist(), strict=True):
        for frame, xy in zip(track.frames.tolist(), track.xy, strict=True):
            if frame in position:
                seen.setdefault(position[frame], []).append((own, xy))
    images, beside = list(measured.images), list[Array]()
    for k, places in seen.items():
        camera = measured.camera if lenses is None else lenses.get(measured.frames[k].index, measured.camera)
        xy = on_footage(np.array([place for _, place in places]), given, camera)
        if not np.isfinite(xy).all():
            row = int(np.argmin(np.isfinite(xy).all(axis=1)))
            name = kept[places[row][0] - first].name
            raise InputError(f"{given.source}: {name} is outside of the lens in frame {measured.frames[k].index}")
        beside.append(_beside(xy, camera))
        tracks = images[k].tracks.joined(np.array([own for own, _ in places]), xy)
        images[k] = replace(images[k], tracks=tracks)
    _check_inside(given, np.concatenate(beside), measured.camera)
    known, colors = measured.supervised, np.full((first + len(kept), 3), _GREY, np.uint8)
    colors[: min(first, len(measured.colors))] = measured.colors[:first]
    supervised = SupervisedTracks(
        np.r_[known.ids, ids],
        (*known.names, *_new_names([track.name for track in kept], known.names, first)),
        np.r_[known.sigma, [given.sigma / track.weight for track in kept]],
        known.join,
    )
    notes = (*measured.notes, *given.notes)
    if away := len(given.tracks) - len(kept):
        notes = (*notes, f"Of {given.source}, {away} of {len(given.tracks)} have no frame of the shot.")
    return replace(measured, images=images, supervised=supervised, colors=colors, notes=notes)


def _check_size(given: UserTracks, camera: pycolmap.Camera) -> None:
    if given.size is not None and given.size != (camera.width, camera.height):
        width, height = given.size
        raise InputError(
            f"{given.source}: they are of an image of {width}x{height} pixels, the footage has "
            f"{camera.width}x{camera.height}; tracks of footage of that size are expected"
        )


def _beside(xy: Array, camera: pycolmap.Camera) -> Array:
    """(n,) how far places are beyond the border of the image, pixels; negative inside."""
    size = np.array([camera.width, camera.height])
    return np.asarray(np.maximum(-PIXEL_CENTER - xy, xy - (size - PIXEL_CENTER)).max(axis=1))


def _check_inside(given: UserTracks, beside: Array, camera: pycolmap.Camera) -> None:
    """Insist that most places are in the image: those of an image of another size would bend the cameras."""
    outside = int((beside > _BESIDE_PX).sum())
    if outside > _MOST_BESIDE * len(beside):
        raise InputError(
            f"{given.source}: {outside} of {len(beside)} places are outside of the footage of "
            f"{camera.width}x{camera.height} pixels, by up to {beside.max():.0f}; tracks of footage of that size are "
            "expected"
        )


def on_footage(xy: Array, given: UserTracks, camera: pycolmap.Camera) -> Array:
    """(n, 2) places of the tracks on the footage, pixels with centres at integers."""
    if given.from_bottom:
        xy = np.column_stack([xy[:, 0], camera.height - PIXEL_CENTER - xy[:, 1]])
    if given.on == "footage":
        return xy
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    rays = (xy + PIXEL_CENTER - center) / focal
    return np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))) - PIXEL_CENTER


def _new_names(names: list[str], known: tuple[str, ...], first: int) -> list[str]:
    """The names with a number behind those that are taken, by a track of the user or by one of the others."""
    taken, found = {*known, *(track_name(track) for track in range(first))}, []
    for name in names:
        number, free = 2, name
        while free in taken:
            free, number = f"{name}_{number}", number + 1
        taken.add(free)
        found.append(free)
    return found
