"""Photographs in any order: reading them, and telling a folder of them from the frames of a shot."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_images, read_image, stated_pixel_aspect
from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.frames.numbering import FrameFile, chosen, images_of, numbered_images, refuse_negative
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.reading import read_frames
from factorsfm.frames.sequences import begin_with_numbers, is_ordered, mixture, split_sequences
from factorsfm.frames.texture import BLANK_TEXTURE, image_texture
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import as_text

logger = logging.getLogger(__name__)

_PHOTOGRAPH = re.compile(r"(?=\d*[A-Z_])[A-Z0-9_]{4}\d{4}\.\w+")  # DCF, the rule by which cameras name: IMG_1234.JPG
_SAMPLED_PAIRS = 5  # consecutive pairs of images, evenly spread
_SAMPLED_WIDTH = 480  # pixels
_SAMPLED_CORNERS = 200
_TRACKED_SHARE = 0.5  # of the corners, in the median pair, below which the images are no shot
_CHECK_PX = 1.0  # largest forward-backward error of a tracked corner
_PATCH_PX, _PATCH_CORRELATION = 15, 0.9  # side of the patch around a corner, and its least correlation in both images
# Grain leaves little that correlates. Behind a blur that takes it away, most corners of a shot can be tracked and move
# alike, 0.56 to 0.97 of them. So can many of photographs from two places, but by different ways: 0.27 at most alike.
_GRAIN_PX, _ALIKE_PX = 2.5, 5.0  # standard deviation of the blur; most that a corner may move beside the typical one


@dataclass(frozen=True, slots=True)
class Unusable:
    """An image that cannot be read.

    Attributes:
        index, name: as in `Frame`.
        reason: why it cannot be read.
    """

    index: int
    name: str
    reason: str


def read_images(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]],
    frames: slice | None = None,
    *,
    numbered: bool = False,
    fields: Fields = "auto",
) -> Iterator[Frame | Unusable]:
    """The images of a set, of any sizes; an image that cannot be read becomes an `Unusable`.

    Args:
        source, frames, fields: as in `read_frames`.
        numbered: whether the images of a folder are the frames of a shot, with the numbers in their names; photographs
            are counted from 0, since the counters of cameras begin anew.

    Raises:
        InputError: the source is missing or holds no images.
    """
    if isinstance(source, str | Path):
        folder = Path(source)
        if not folder.is_dir():
            yield from read_frames(source, frames, fields=fields)
            return
        if numbered:
            images = chosen(numbered_images(folder), checked_range(frames or slice(None)))
        else:
            images = [FrameFile(*image) for image in enumerate(images_of(folder))][frames or slice(None)]
        for index, path, time in images:
            try:
                aspect = stated_pixel_aspect(path) if numbered else 1.0  # photographs have square pixels
                yield Frame(index, read_image(path), path.name, time, path=path, pixel_aspect=aspect)
            except InputError as error:
                yield Unusable(index, path.name, str(error).replace(f"image {path}", "it"))
        return
    for index, image in list(enumerate(source))[frames or slice(None)]:
        try:
            if isinstance(image, Frame):
                yield image
            else:
                yield Frame(index, bgr_image(image, index), f"{index:06d}")
        except InputError as error:
            yield Unusable(index, f"{index:06d}", str(error))


def other_files(source: Path) -> list[str]:
    """Names of the files of a folder that are not images, without hidden files, as UTF-8 can hold them."""
    if not source.is_dir():
        return []
    images = set(list_images(source))
    return sorted(
        as_text(p.name) for p in source.iterdir() if p.is_file() and p not in images and not p.name.startswith(".")
    )


def looks_unordered(source: Path, frames: slice | None = None) -> bool:
    """Whether a folder holds single photographs rather than the frames of a shot.

    It does if the names differ in more than their numbers, or if in most of a few consecutive pairs the images have
    different sizes or so little overlap that corners cannot be tracked.

    Raises:
        InputError: the folder holds the frames of a shot, and something else: see `numbering.numbered_images`.
    """
    if not source.is_dir():
        return False
    images = list_images(source)
    names = [path.name for path in images]
    refuse_negative(source, names)
    if is_ordered(names):
        images = [image.path for image in chosen(numbered_images(source), checked_range(frames or slice(None)))]
    else:
        _refuse_mixture(source, names)
        images = images[frames or slice(None)]
    if len(images) < 2:
        return False
    reason = _why_unordered(images)
    if reason:
        logger.info("%s is taken as an unordered set: %s", source, reason)
    return bool(reason)


def _refuse_mixture(folder: Path, names: list[str]) -> None:
    """Refuse several sequences in a folder, or other files beside one, unless these are photographs.

    Photographs have the names that cameras give, or share too little with the next one for a shot.
    """
    found = mixture(names)
    if not found:
        return
    sequences, _ = split_sequences(names)
    files = [[folder / f"{name.prefix}{name.digits}{name.suffix}" for name in sequence] for sequence in sequences]
    if any(_PHOTOGRAPH.fullmatch(sequence[0].name) for sequence in files) or _too_little_is_shared(files[0]):
        return
    raise InputError(
        f"folder {folder} holds {found}; a folder with one of them is expected, unless they are given as unordered"
    )


def _why_unordered(paths: list[Path]) -> str:
    patterns = {path.stem.rstrip("0123456789") for path in paths}
    alike = len(patterns) == 1 and all(path.stem[-1:].isdigit() for path in paths)
    names = [path.name for path in paths]
    if not alike and not is_ordered(names) and not begin_with_numbers(names):
        return "the names are not numbered alike"
    return _too_little_is_shared(paths)


def _too_little_is_shared(paths: list[Path]) -> str:
    """Why images in this order are no shot by what they show; empty if they are one."""
    shares = []
    for k in np.unique(np.linspace(0, len(paths) - 2, _SAMPLED_PAIRS).astype(int)):
        try:
            first, second = read_image(paths[k]), read_image(paths[k + 1])
        except InputError:
            continue
        shares.append(_tracked_share(first, second) if first.shape == second.shape else 0.0)
    if shares and np.median(shares) < _TRACKED_SHARE:
        return f"{100 * np.median(shares):.0f} % of the corners can be tracked from one image to the next"
    return ""


def _tracked_share(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Share of the corners of the first image that can be tracked to the second, with their grain or without it.

    It is 1 if the first image is blank, has no corners, or is smaller than a patch: then nothing can be said.
    """
    if min(first.shape[:2]) < _PATCH_PX or image_texture(cv2.cvtColor(first, cv2.COLOR_BGR2GRAY)) < BLANK_TEXTURE:
        return 1.0
    size = (_SAMPLED_WIDTH, max(1, round(_SAMPLED_WIDTH * first.shape[0] / first.shape[1])))
    small = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (first, second))
    a, b = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in small)
    tracked, _ = _tracked_corners(a, b)
    if not len(tracked):
        return 1.0
    found, moved = _tracked_corners(*(cv2.GaussianBlur(image, (0, 0), _GRAIN_PX) for image in (a, b)))
    if not found.any():
        return float(tracked.mean())
    alike = np.linalg.norm(moved - np.median(moved[found], axis=0), axis=1) < _ALIKE_PX
    return float(max(tracked.mean(), (found & alike).mean()))


def _tracked_corners(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether (n,) corners of a grey image pass the forward-backward check and look the same in another, and (n, 2)
    their motion.
    """
    corners = cv2.goodFeaturesToTrack(a, _SAMPLED_CORNERS, 0.01, 8)
    if corners is None:
        return np.zeros(0, bool), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None)
    error = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    same = _correlation(_patches(a, corners), _patches(b, there)) > _PATCH_CORRELATION
    tracked = found.ravel().astype(bool) & found_back.ravel().astype(bool) & (error < _CHECK_PX) & same
    return tracked, np.asarray((there - corners).reshape(-1, 2), np.float64)


def _patches(image: NDArray[np.uint8], at: NDArray[np.float32]) -> NDArray[np.float64]:
    """(n, pixels) of the patches around n positions, sub-pixel."""
    size = (_PATCH_PX, _PATCH_PX)
    patches = [cv2.getRectSubPix(image, size, tuple(map(float, xy))).ravel() for xy in at.reshape(-1, 2)]
    return np.array(patches, np.float64)


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) normalised cross-correlation of the rows of two (n, pixels) arrays."""
    a, b = (p - p.mean(axis=1, keepdims=True) for p in (a, b))
    power = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    return np.asarray((a * b).sum(axis=1) / np.maximum(power, 1e-9))
