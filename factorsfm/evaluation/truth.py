"""A shot with its ground truth: frames, lens, poses, depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]
DepthLookup = Callable[[int], NDArray[np.float32] | None]


def no_depth(index: int) -> None:
    """The depth look-up of a shot without depth."""
    return None


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image (h, w, 3) uint8 BGR.

    Raises:
        InputError: the file is missing or no image.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path} cannot be read as an image")
    return np.asarray(image, np.uint8)


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Depth look-up from integer image files.

    Attributes:
        files: frame index -> file.
        unit: metres per step.
        invalid: value that, like 0, means no depth.
    """

    files: Mapping[int, Path]
    unit: float
    invalid: int = 0

    def __call__(self, index: int) -> NDArray[np.float32] | None:
        if index not in self.files:
            return None
        steps = cv2.imread(str(self.files[index]), cv2.IMREAD_UNCHANGED)
        if steps is None or steps.ndim != 2:
            raise InputError(f"{self.files[index]} is not a depth map of one channel")
        known = (steps != 0) & (steps != self.invalid)
        return np.where(known, steps * np.float32(self.unit), np.nan).astype(np.float32)


@dataclass(frozen=True, slots=True)
class RawDepthMaps:
    """Depth look-up from headerless little-endian float32 files in metres (ETH3D).

    Attributes:
        files: frame index -> file.
        shape: (h, w) of every map.
    """

    files: Mapping[int, Path]
    shape: tuple[int, int]

    def __call__(self, index: int) -> NDArray[np.float32] | None:
        if index not in self.files:
            return None
        depth = np.fromfile(self.files[index], "<f4").reshape(self.shape)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Shot:
    """Frames of one shot with its true camera.

    Attributes:
        name: for tables.
        source: video file, or folder of the images.
        camera: the true lens (COLMAP convention: pixel centres at 0.5).
        indices: (n,) frames with true pose, ascending: positions in the video or in `files`.
        rotations: (n, 3, 3) true world_from_cam.
        centers: (n, 3) true camera centres, metres.
        depth: frame index -> true z (h, w) float32 in metres, NaN = none; None for a frame without a map.
        masks: folder of masks of what moves, or None.
        files: the images in order, None for a video.
    """

    name: str
    source: Path
    camera: pycolmap.Camera
    indices: NDArray[np.int64]
    rotations: Array
    centers: Array
    depth: DepthLookup = no_depth
    masks: Path | None = None
    files: tuple[Path, ...] | None = None

    def frames(self) -> Iterator[Frame]:
        """All frames of the source, in order.

        Raises:
            InputError: a frame cannot be read.
        """
        if self.files is None:
            yield from read_frames(self.source)
            return
        for index, path in enumerate(self.files):
            yield Frame(index=index, image=read_image(path), name=path.name, timestamp=None)

    def truth(self, indices: NDArray[np.int64]) -> tuple[Array, Array]:
        """True rotations (k, 3, 3) and centres (k, 3) of the frames (k,).

        Raises:
            InputError: a frame has no true pose.
        """
        missing = np.setdiff1d(indices, self.indices)
        if len(missing):
            raise InputError(f"frame {missing[0]} of {self.name} has no true pose")
        rows = np.searchsorted(self.indices, indices)
        return self.rotations[rows], self.centers[rows]
