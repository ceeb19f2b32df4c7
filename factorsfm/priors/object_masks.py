"""Masks of things that move by themselves: a folder that tells them apart by name or by number."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.frame_folder import FrameFolder, check_aspect
from factorsfm.support.errors import InputError

_SUFFIXES = (".png", ".bmp", ".tif", ".tiff")
FROM_MOTION = "auto"  # in place of masks: whatever moves by itself
_MOST_OBJECTS = 50  # in one mask; more values are those of a smoothed outline


@runtime_checkable
class ObjectMasks(Protocol):
    """A callable that gives the masks of the objects in a frame."""

    def __call__(self, frame: Frame) -> dict[str, NDArray[np.bool_]]:
        """(h, w) by name of the object, of any size with the frame's aspect ratio, True where it is seen."""


class ObjectFolder:
    """A folder of masks of objects; a frame may lack any of them.

    Either it has a subfolder for each object, named as the object, with masks in which non-zero means the object. Or it
    holds masks in which 0 is the scene and every other value an object, named "object-1" and so on. Masks are .png,
    .bmp or .tif images of any size, with the aspect ratio of their frame, and belong to it as in `MaskFolder`.

    Args:
        path: the folder.

    Attributes:
        name: name of the folder.
        asked, matched: number of frames whose masks were asked for, and of those among them that have one.

    Raises:
        InputError: the folder does not exist, or holds neither masks nor subfolders with masks.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        if not path.is_dir():
            raise InputError(f"there is no folder {path} of masks of objects")
        subfolders = sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith("."))
        self.name = path.name
        self.asked = self.matched = 0
        self._objects = {p.name: FrameFolder(p, _SUFFIXES, "masks of an object") for p in subfolders}
        self._labels = None if subfolders else FrameFolder(path, _SUFFIXES, "masks of objects")

    def has(self, index: int) -> bool:
        """Whether the folder has a mask for this frame of a video."""
        folders = [*self._objects.values(), *([self._labels] if self._labels is not None else [])]
        return any(folder.has(index) for folder in folders)

    def __call__(self, frame: Frame) -> dict[str, NDArray[np.bool_]]:
        """The masks of the objects in a frame.

        Raises:
            InputError: a mask cannot be read, has another aspect ratio than the frame, or no numbers of objects.
        """
        found: dict[str, NDArray[np.bool_]] = {}
        for name, folder in self._objects.items():
            if (path := folder.file_of(frame)) is not None:
                found[name] = (_read(path, frame) != 0).any(axis=2)
        path = self._labels.file_of(frame) if self._labels is not None else None
        if path is not None:
            labels = _read(path, frame)
            if (labels != labels[..., :1]).any():
                raise InputError(f"the mask {path} is coloured; expected grey values, one for each object")
            values = [value for value in np.unique(labels[..., 0]).tolist() if value]
            if len(values) > _MOST_OBJECTS:
                raise InputError(
                    f"the mask {path} has {len(values)} values; expected one for each object, at most {_MOST_OBJECTS}"
                )
            found = {f"object-{value}": labels[..., 0] == value for value in values}
        self.asked += 1
        self.matched += path is not None or bool(found)
        return found


def open_objects(spec: str | Path | ObjectMasks | None) -> ObjectMasks | None:
    """The masks of objects that `spec` names.

    Args:
        spec: a folder as `ObjectFolder` reads it, "none" or None; what is callable is returned as it is.

    Raises:
        InputError: `spec` is none of these.
    """
    if spec is None or spec == "none":
        return None
    if isinstance(spec, str | Path):
        return ObjectFolder(spec)
    if not isinstance(spec, ObjectMasks):
        raise InputError(f"masks of objects must be callable with a frame, not {spec!r}")
    return spec


def _read(path: Path, frame: Frame) -> NDArray[np.generic]:
    """(h, w, c) without alpha."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"the mask {path} cannot be read")
    check_aspect(image, frame, path)
    return np.asarray(image.reshape(*image.shape[:2], -1)[..., :3])
