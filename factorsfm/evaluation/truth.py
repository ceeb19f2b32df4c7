"""A shot with its ground truth: frames, lens, poses and depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.folders import read_image
from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]
DepthLookup = Callable[[int], NDArray[np.float32] | None]


def no_depth(index: int) -> None:
    """The depth look-up of a shot without depth maps."""
    return None


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Depth look-up from images of integers.

    Attributes:
        files: the file of each frame index.
        unit: metres per grey level.
        invalid: a grey level that means no depth, as 0 does.
    """

    files: Mapping[int, Path]
    unit: float
    invalid: int = 0

    def __call__(self, index: int) -> NDArray[np.float32] | None:
        if index not in self.files:
            return None
        levels = cv2.imread(str(self.files[index]), cv2.IMREAD_UNCHANGED)
        if levels is None or levels.ndim != 2:
            raise InputError(f"{self.files[index]} is not a depth map of one channel")
        valid = (levels != 0) & (levels != self.invalid)
        return np.where(valid, levels * np.float32(self.unit), np.nan).astype(np.float32)


@dataclass(frozen=True, slots=True)
class RawDepthMaps:
    """Depth look-up from files of little-endian float32 values in metres without a header (ETH3D).

    Attributes:
        files: the file of each frame index.
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
    """A shot with its true lens, poses and depth.

    Attributes:
        name: name in tables.
        source: video file, or folder of the images.
        camera: the true lens (COLMAP convention: pixel centres at 0.5).
        indices: (n,) frames with a true pose, ascending; positions in the video or in `files`.
        rotations: (n, 3, 3) true world_from_cam.
        centers: (n, 3) true camera centres, metres.
        depth: gives the true z-depth of a frame index, (h, w) float32 in metres, NaN where it has none; or None if the
            frame has no map.
        masks: folder of masks of what moves; None if there is none.
        files: the images in order; None for a video.
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
        """True rotations world_from_cam (k, 3, 3) and camera centres (k, 3) of frame indices (k,).

        Raises:
            InputError: a frame has no true pose.
        """
        missing = np.setdiff1d(indices, self.indices)
        if len(missing):
            raise InputError(f"frame {missing[0]} of {self.name} has no true pose")
        rows = np.searchsorted(self.indices, indices)
        return self.rotations[rows], self.centers[rows]
