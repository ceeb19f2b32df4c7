"""The cameras of an image set: which images share one, what is known of each, and its lens in the result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pycolmap

from factorsfm.camera.guess import guess_camera
from factorsfm.camera.projection import with_focal
from factorsfm.imagesets.photo_folder import Photo, PhotoFolder, size_text
from factorsfm.lens.camera_model import with_distortion
from factorsfm.lens.lens import Lens
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError

_SAME_ASPECT = 0.01
_SAME_FOCAL = 0.01  # relative, of what EXIF says: a zoom lens has many


def find_cameras(photos: Sequence[Photo], files: PhotoFolder, given: pycolmap.Camera | None) -> list[pycolmap.Camera]:
    """The cameras, at the full size of their images; `Photo.camera` becomes the position in the list.

    Images of one format (aspect ratio) with the same focal length in their EXIF data share a camera: other sizes count
    as scaled, upright ones among others are turned. Those without EXIF go with most of their format.

    Args:
        given: the camera of its format, whatever EXIF says; the first of the list.

    Returns:
        A camera for each group, that with most images first where none is given.

    Raises:
        InputError: no image has the format of the given camera.
    """
    formats = _formats(photos, files, given)
    if given is not None and not formats[0]:
        raise InputError(
            f"the camera is made for {size_text((given.width, given.height))} pixels, but none of the {len(photos)} "
            "images has this format"
        )
    groups = [group for k, members in enumerate(formats) for group in _groups(members, given is not None and k == 0)]
    first = groups[:1] if given is not None else []
    groups = first + sorted(groups[len(first) :], key=lambda group: -len(group))
    cameras = []
    for k, group in enumerate(groups):
        for photo in group:
            photo.camera = k
        cameras.append(given if given is not None and k == 0 else _camera(group))
    return cameras


def describe_cameras(cameras: Sequence[pycolmap.Camera], photos: Sequence[Photo], given: bool) -> str:
    """What is known of several cameras, in one sentence; empty where there is one."""
    if len(cameras) < 2:
        return ""
    said = []
    for k, camera in enumerate(cameras):
        count = sum(photo.camera == k for photo in photos)
        origin = "given" if given and k == 0 else "from EXIF" if camera.has_prior_focal_length else "a guess"
        size = size_text((camera.width, camera.height))
        said.append(f"{count} of {size} pixels with a focal length of {camera.mean_focal_length():.0f} ({origin})")
    return f"The images come from {len(cameras)} cameras: {'; '.join(said)}."


def add_lenses(
    result: Reconstruction,
    photos: Sequence[Photo],
    cameras: Sequence[pycolmap.Camera],
    first: pycolmap.Camera,
    found: Lens | None,
) -> None:
    """Give a result the lenses of its images at full size, and errors in their pixels instead of those of the map.

    Args:
        photos: in the order of the result's frames; cameras: as they were known first, at full size.
        first: the first one, with which the map was made; found: what was found of it, None where it was given.
    """
    ratio = result.camera.mean_focal_length() / first.mean_focal_length()
    shape = found.shape if found is not None and found.bends else None
    lenses = []
    for k, camera in enumerate(cameras):
        focal = ratio * camera.mean_focal_length()
        own = with_focal(camera, focal) if shape is None else with_distortion(camera, focal, shape)
        lenses.append(resized(result.camera, (camera.width, camera.height)) if k == 0 else own)
    shared = Counter(p.camera for p, f in zip(photos, result.frames, strict=True) if f.registered)
    most = shared.most_common(1)[0][0]
    factor = np.array([lenses[photo.camera].mean_focal_length() for photo in photos])
    factor /= result.camera.mean_focal_length()
    result.camera = lenses[most]
    by_observation = factor[result.observation_frame]
    result.observation_error = result.observation_error * by_observation
    if result.noise is not None:
        result.noise = replace(result.noise, pixel=result.noise.pixel * by_observation)
    for frame, photo, own_factor in zip(result.frames, photos, factor.tolist(), strict=True):
        if photo.camera != most:
            frame.camera = lenses[photo.camera]
        frame.reprojection_error *= own_factor
        if frame.observability is not None:
            slide = frame.observability.pixel_slide * own_factor
            frame.observability = replace(frame.observability, pixel_slide=slide)


def resized(camera: pycolmap.Camera, size: tuple[int, int]) -> pycolmap.Camera:
    """A copy for images of another size."""
    other = pycolmap.Camera(camera.todict())
    other.rescale(*size)
    return other


def _formats(photos: Sequence[Photo], files: PhotoFolder, given: pycolmap.Camera | None) -> list[list[Photo]]:
    """Photos of the same aspect ratio, that of the given camera first; what lies on its side is turned."""
    sizes = [] if given is None else [(int(given.width), int(given.height))]
    sizes += [size for size, _ in Counter(photo.full_size for photo in photos).most_common()]
    formats: dict[tuple[int, int], list[Photo]] = {} if given is None else {sizes[0]: []}
    for size in sizes:
        if not any(_alike(size, known) or _alike(size[::-1], known) for known in formats):
            formats[size] = []
    for photo in photos:
        chosen = next((f for f in formats if _alike(photo.full_size, f)), None)
        if chosen is None:
            chosen = next(f for f in formats if _alike(photo.full_size[::-1], f))
            files.turn(photo)
        formats[chosen].append(photo)
    return list(formats.values())


def _groups(photos: list[Photo], one: bool) -> list[list[Photo]]:
    """Photos with the same focal length, by their EXIF data."""
    told = sorted((photo for photo in photos if photo.focal_ratio > 0), key=lambda photo: photo.focal_ratio)
    if one or not told:
        return [photos] if photos else []
    ratios = np.array([photo.focal_ratio for photo in told])
    starts = [0, *(np.nonzero(np.diff(np.log(ratios)) > _SAME_FOCAL)[0] + 1).tolist(), len(told)]
    groups = [told[a:b] for a, b in pairwise(starts)]
    max(groups, key=len).extend(photo for photo in photos if photo.focal_ratio <= 0)
    return groups


def _camera(photos: list[Photo]) -> pycolmap.Camera:
    width, height = Counter(photo.full_size for photo in photos).most_common(1)[0][0]
    camera = guess_camera(width, height)
    ratios = [photo.focal_ratio for photo in photos if photo.focal_ratio > 0]
    if ratios:
        camera.focal_length = float(np.median(ratios)) * max(width, height)
        camera.has_prior_focal_length = True
    return camera


def _alike(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1.0) < _SAME_ASPECT
