"""The distortion of the lens as a pair of STMaps, and undistorted footage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER, pixels_from_normalized, without_distortion
from factorsfm.camera.undistortion import Straightening, distorted_places, pixel_grid
from factorsfm.export.footage import warn_of_missing
from factorsfm.export.shot import Shot
from factorsfm.frames.folders import read_pixels
from factorsfm.frames.reading import read_frames
from factorsfm.frames.writing import write_exr, write_image
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

UNDISTORT, DISTORT = "undistort", "distort"

_NOWHERE = -1.0  # outside of every image


def write_stmaps(shot: Shot, folder: Path) -> None:
    """Write ``undistort.exr`` and ``distort.exr``: 32-bit float; red and green hold the x and y to look up.

    Positions count in widths and heights of the image from its bottom left corner, to a pixel's centre: the identity
    map holds ``(column + 0.5) / width`` and ``1 - (row + 0.5) / height``, with rows counted from the top. Blue is 0.
    `undistort.exr` undistorts footage, `distort.exr` distorts a render to fit the footage. Both keep size, focal length
    and principal point, so the exported camera fits the undistorted footage. Pixels without a counterpart hold -1. A
    zoom has a pair for each registered frame, with the number of the frame: ``undistort.1001.exr``.
    """
    for suffix, camera in _cameras(shot):
        places = distorted_places(camera, without_distortion(camera))
        write_exr(folder / f"{UNDISTORT}{suffix}.exr", _stmap(places, camera))
        write_exr(folder / f"{DISTORT}{suffix}.exr", _stmap(_undistorted_places(camera), camera))


def write_undistorted(shot: Shot, folder: Path) -> None:
    """Write every frame of the footage undistorted, with cubic interpolation, as ``plate.NUMBER.png`` or ``.exr``.

    Nothing of the plates is lost: images of 8 or 16 bits become PNG of 8 or 16 bits, linear light (EXR) becomes EXR of
    half or float. Unregistered frames and frames outside of the reconstructed range are included, so that the plates
    can replace the footage. With a zoom, such a frame uses the lens of the frame before it. A warning names frames of
    the reconstruction that the footage lacks.

    Raises:
        InputError: there is no footage, or its size is not that of the camera.
    """
    camera = shot.reconstruction.camera
    if shot.footage is None:
        raise InputError("there is no footage to undistort; name a video file or a folder of images")
    own = {frame.index: frame.camera for frame in shot.reconstruction.frames if frame.camera is not None}
    straightening = _straightening(camera)
    held = set()
    for frame in read_frames(shot.footage, fields=shot.fields):
        height, width = frame.image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"the footage {shot.footage} has {width}x{height} pixels, the camera {camera.width}x{camera.height}"
            )
        held.add(frame.index)
        index = frame.index - shot.numbering.shift
        if index in own:
            straightening = _straightening(own[index])
        pixels = frame.image if frame.path is None else read_pixels(frame.path)
        plate = straightening.image(pixels)
        name = f"plate.{shot.first_frame + index:04d}"
        if plate.dtype.kind == "f":
            write_exr(folder / f"{name}.exr", plate[..., ::-1])
        else:
            write_image(folder / f"{name}.png", plate)
    warn_of_missing(shot, held)


def _cameras(shot: Shot) -> list[tuple[str, pycolmap.Camera]]:
    """The lenses, each with the suffix of its maps' names."""
    if not shot.zooms:
        return [("", shot.reconstruction.camera)]
    registered = zip(shot.numbers, shot.reconstruction.registered, strict=True)
    return [(f".{number:04d}", shot.reconstruction.camera_of(frame)) for number, frame in registered]


def _straightening(camera: pycolmap.Camera) -> Straightening:
    return Straightening(camera, without_distortion(camera))


def _undistorted_places(camera: pycolmap.Camera) -> Array:
    """(h, w, 2) position in the undistorted image of each pixel of the distorted one, in pixels from the corner."""
    rays = np.asarray(camera.cam_from_img(pixel_grid(camera)), np.float64)
    places = pixels_from_normalized(without_distortion(camera), rays) + PIXEL_CENTER
    return places.reshape(camera.height, camera.width, 2)


def _stmap(places: Array, camera: pycolmap.Camera) -> NDArray[np.float32]:
    """(h, w, 3) red, green, blue."""
    x, y = places[..., 0] / camera.width, 1 - places[..., 1] / camera.height
    outside = ~(np.isfinite(x) & np.isfinite(y))
    image = np.stack([x, y, np.zeros_like(x)], axis=-1)
    image[outside, :2] = _NOWHERE
    return image.astype(np.float32)
