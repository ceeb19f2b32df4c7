"""What trainers of splats and radiance fields read beside cameras and points: images, and masks of what moves."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePath

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized
from factorsfm.camera.undistortion import Straightening, distorts, filled_pinhole
from factorsfm.export.image_names import image_name
from factorsfm.export.moving_mask import moving_mask
from factorsfm.export.other_pixels import in_other_pixels
from factorsfm.export.shot import Shot
from factorsfm.frames.folders import read_image
from factorsfm.frames.frame import Frame
from factorsfm.frames.photographs import in_format_of
from factorsfm.frames.plates import PLATE_SUFFIXES
from factorsfm.frames.reading import read_frames
from factorsfm.frames.writing import write_image
from factorsfm.priors.masks import MaskPrior, open_masks
from factorsfm.result.image_sources import image_sources
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

IMAGES, MASKS = "images", "masks"

_BEST_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def seen_in_training(shot: Shot) -> Reconstruction:
    """The result with the cameras of the images for training, pinholes if they are to be undistorted, and their names.

    Those that trainers cannot read, such as EXR, are 8-bit PNG; all others keep their names.
    """
    old = shot.reconstruction
    new = in_other_pixels(old, filled_pinhole, _straightened) if shot.options.undistorted else old
    return replace(new, frames=[replace(frame, name=_trained_name(frame.name)) for frame in new.frames])


def write_training_images(shot: Shot, new: Reconstruction, folder: Path) -> dict[str, str]:
    """Write ``images/`` and, where something moves or masks are given, ``masks/`` with one for every image.

    A mask has the name of its image and ends in .png; it is black where the image is to be ignored. Without footage
    nothing is written.

    Args:
        new: what `seen_in_training` gives.

    Returns:
        The names of the masks by those of the images; empty without masks.

    Raises:
        InputError: the footage lacks frames, or there is none to undistort, or the masks cannot be read.
    """
    old = shot.reconstruction
    if shot.footage is None:
        if shot.options.undistorted:
            raise InputError("there is no footage to undistort; name a video file or a folder of images")
        logger.warning("there is no footage: put the frames into %s/ under their names", IMAGES)
        return {}
    names = {frame.index: frame.name for frame in new.registered}
    given = open_masks(shot.options.masks)
    masked = given is not None or old.moving is not None or bool(old.objects)
    masks = _mask_names(list(names.values())) if masked else {}
    writer = _Writer(shot, new, folder, given, masks)
    for source in image_sources(shot.footage, old.options):
        here = [frame for frame in old.registered if source.holds(frame.index)]
        shift = shot.numbering.shift if source.path == shot.footage else -source.first
        if source.path is None and here:
            missing = ", ".join(names[frame.index] for frame in here)
            logger.warning("there are no files of %s: put these images into %s/", missing, IMAGES)
        elif source.path is not None and here:
            writer.write_all(source.path, here, shift)
    return masks


def _trained_name(name: str) -> str:
    """The name of the image for training, which is 8-bit PNG where trainers cannot read the file itself."""
    return (
        str(PurePath(name).with_suffix(".png")) if PurePath(name).suffix.lower() in PLATE_SUFFIXES else image_name(name)
    )


def _mask_names(images: list[str]) -> dict[str, str]:
    """By name of the image. Trainers look for its stem, or for the whole name, as COLMAP does: here if stems repeat."""
    stems = [str(PurePath(name).with_suffix(".png")) for name in images]
    unique = len(set(stems)) == len(stems)
    return {name: stem if unique else f"{name}.png" for name, stem in zip(images, stems, strict=True)}


def _straightened(camera: pycolmap.Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return pixels_from_normalized(filled_pinhole(camera), normalized_from_pixels(camera, xy))


class _Writer:
    """Writes images and masks into a folder.

    Args:
        shot: with the cameras of the footage; new: with those of the images to write, frame by frame, and their names.
        given: masks of what is to be ignored besides what moves; masks: names by image.
    """

    def __init__(
        self, shot: Shot, new: Reconstruction, folder: Path, given: MaskPrior | None, masks: dict[str, str]
    ) -> None:
        self._shot, self._folder, self._given, self._masks = shot, folder, given, masks
        self._new = {frame.index: (frame.name, new.camera_of(frame)) for frame in new.registered}
        self._lens: pycolmap.Camera | None = None  # that the straightening is for
        self._straightening: Straightening | None = None

    def write_all(self, footage: Path, frames: list[FrameResult], shift: int) -> None:
        """Write what a video or a folder holds of the frames; `shift` is what it counts more than the result."""
        for folder in {(self._folder / IMAGES / self._new[frame.index][0]).parent for frame in frames}:
            folder.mkdir(parents=True, exist_ok=True)
        for frame, path, image in _images_of(self._shot, footage, frames, shift):
            self._write(frame, path, image)

    def _write(self, frame: FrameResult, path: Path | None, image: NDArray[np.uint8] | None) -> None:
        name, camera = self._new[frame.index]
        lens = self._shot.reconstruction.camera_of(frame)
        bends = self._shot.options.undistorted and distorts(lens)
        target = self._folder / IMAGES / name
        copied = path is not None and not bends and path.suffix == target.suffix and not _is_turned(path)
        if path is not None and (not copied or self._masks or self._shot.are_photographs):
            image = read_image(path)
        stored = image
        if image is not None and self._shot.are_photographs:
            image = in_format_of(lens, image)  # turned and scaled as it was solved
            copied = copied and image is stored
        if image is not None and image.shape[:2] != (lens.height, lens.width):
            raise InputError(
                f"the image {frame.name} of the footage has {image.shape[1]}x{image.shape[0]} pixels, the camera "
                f"{lens.width}x{lens.height}"
            )
        if bends and self._lens != lens:
            self._lens, self._straightening = lens, Straightening(lens, camera)
        straightening = self._straightening if bends else None
        if copied and path is not None:
            shutil.copyfile(path, target)
        elif image is not None:
            options = _BEST_JPEG if target.suffix.lower() in (".jpg", ".jpeg") else ()
            write_image(target, image if straightening is None else straightening.image(image), options)
        if self._masks and image is not None and stored is not None:
            kept = ~self._ignored(frame, image, stored)
            mask = self._folder / MASKS / self._masks[name]
            mask.parent.mkdir(parents=True, exist_ok=True)
            write_image(mask, 255 * (kept if straightening is None else straightening.mask(kept)).astype(np.uint8))

    def _ignored(self, frame: FrameResult, image: NDArray[np.uint8], stored: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(h, w) what of an image is to be ignored; `stored`: as it is in the footage, to which masks belong."""
        given = self._given(Frame(frame.index, stored, frame.name)) if self._given is not None else None
        moving = moving_mask(self._shot.reconstruction, frame, Frame(frame.index, image, frame.name))
        if given is None:
            return moving
        if self._shot.are_photographs:
            lens = self._shot.reconstruction.camera_of(frame)
            given = in_format_of(lens, 255 * given.astype(np.uint8)) > 127
        return moving | given


def _images_of(
    shot: Shot, footage: Path, frames: list[FrameResult], shift: int
) -> Iterator[tuple[FrameResult, Path | None, NDArray[np.uint8] | None]]:
    """The frames with the files of their images, where these bear their names, else with their images."""
    other = {}
    for frame in frames:
        if (footage / frame.name).is_file():
            yield frame, footage / frame.name, None
        else:
            other[frame.index + shift] = frame
    if not other:
        return
    indices = sorted(other)
    for read in read_frames(footage, slice(indices[0], indices[-1] + 1), fields=shot.fields):
        if (found := other.pop(read.index, None)) is not None:
            yield found, None, read.image
    if other:
        raise InputError(f"the footage {footage} lacks frame {min(other)}")


def _is_turned(path: Path) -> bool:
    """Whether EXIF data turn an image: trainers read its pixels as they are stored."""
    small = cv2.IMREAD_REDUCED_GRAYSCALE_8
    shown, stored = (cv2.imread(str(path), flags) for flags in (small, small | cv2.IMREAD_IGNORE_ORIENTATION))
    return shown is not None and stored is not None and not np.array_equal(shown, stored)
