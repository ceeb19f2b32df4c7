"""Mask priors: which pixels of a frame to ignore, because they show something that moves."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.frame_folder import FrameFolder, check_aspect, image_stem
from factorsfm.priors.models import find_model
from factorsfm.priors.networks import Network, NetworkSpec
from factorsfm.support.errors import InputError, ModelError

# Labels of PASCAL VOC that move: bird, cat, cow, dog, horse, person, sheep; and aeroplane, bicycle, boat, bus, car,
# motorbike, train.
PEOPLE_LABELS = frozenset({3, 8, 10, 12, 13, 15, 17})
MOVABLE_LABELS = PEOPLE_LABELS | {1, 2, 4, 6, 7, 14, 19}

# What the named segmentation network can be asked for.
NAMED_MASKS = {"people": PEOPLE_LABELS, "movable": MOVABLE_LABELS}
_NAMED_NETWORK = "deeplab"

# How far masks grow, as a share of the image width: their outlines are not exact, and the window of a track reaches
# across them.
DEFAULT_MARGIN = 0.006


@runtime_checkable
class MaskPrior(Protocol):
    """A callable that gives the mask of a frame.

    What it marks is ignored, unless it has an attribute `soft` that is true: then a video's tracks on it are followed
    and suspected, and those that agree with the rest of the scene take part after all (`streaming.suspicion`).
    """

    def __call__(self, frame: Frame) -> NDArray[np.bool_] | None:
        """(h, w) in the size of the frame, True = ignore; None if it has no mask."""


class MaskFolder(FrameFolder):
    """A folder of masks, one file per frame; frames may lack one.

    Masks are .png, .bmp or .tif images of any size, with the aspect ratio of their frame; non-zero means ignore. Files
    named as COLMAP names them (the full image name and ".png", as in "a.jpg.png") follow COLMAP: zero means ignore. A
    mask belongs to the frame of its name or number, as in `DepthFolder`.

    Args:
        path: the folder.
        margin: how far the ignored area grows, as a share of the image width.

    Attributes:
        asked, matched: number of frames whose mask was asked for, and of those among them that have one.

    Raises:
        InputError: the folder does not exist or holds no mask, or the margin is negative.
    """

    def __init__(self, path: str | Path, margin: float = DEFAULT_MARGIN) -> None:
        super().__init__(Path(path), (".png", ".bmp", ".tif", ".tiff"), "masks")
        self._margin = _checked_margin(margin)

    def __call__(self, frame: Frame) -> NDArray[np.bool_] | None:
        """The mask of a frame, None if the folder has none for it.

        Raises:
            InputError: the mask cannot be read, or has another aspect ratio than the frame.
        """
        path = self.file_of(frame)
        if path is None:
            return None
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise InputError(f"the mask {path} cannot be read")
        check_aspect(image, frame, path)
        channels = image.reshape(*image.shape[:2], -1)[..., :3]  # without alpha
        marked = (channels != 0).any(axis=2)
        is_colmap_style = image_stem(path.stem) != path.stem
        return fitted(~marked if is_colmap_style else marked, frame, self._margin)


class MaskModel:
    """A semantic segmentation network in an ONNX file, such as DeepLab.

    Its output is a label map, (1, h, w) of integers, or one score map per label, of which the highest score counts.

    Args:
        path_or_name: the file, or a named network.
        spec: how the network expects its image; guessed by default, see `Network`.
        labels: labels to ignore; by default persons, animals and vehicles of PASCAL VOC.
        margin: how far the ignored area grows, as a share of the image width.

    Attributes:
        name: name of the file.
        soft: always true: a network takes statues, posters and parked cars for what moves.

    Raises:
        ModelError: the network cannot be found, fetched or loaded, or does not take one image.
        InputError: no labels, or a negative margin.
    """

    soft = True

    def __init__(
        self,
        path_or_name: str | Path,
        spec: NetworkSpec | None = None,
        labels: Collection[int] = MOVABLE_LABELS,
        margin: float = DEFAULT_MARGIN,
    ) -> None:
        if not labels:
            raise InputError("a mask network needs at least one label to ignore")
        self._network = Network(find_model(path_or_name), spec)
        self._labels = sorted(labels)
        self._margin = _checked_margin(margin)
        self.name = self._network.path.name

    def __call__(self, frame: Frame) -> NDArray[np.bool_]:
        """The mask of a frame.

        Raises:
            ModelError: the network fails on this frame, or gives no label map.
        """
        labels = self._label_map(self._network(frame.image))
        return fitted(np.isin(labels, self._labels), frame, self._margin)

    def _label_map(self, output: NDArray[Any]) -> NDArray[Any]:
        if output.ndim == 4 and output.dtype.kind == "f" and output.shape[0] == 1:
            axis = 1 if self._network.spec.layout == "NCHW" else 3
            if output.shape[axis] > 1:
                return np.asarray(output.argmax(axis=axis)[0])
        labels = output.reshape([length for length in output.shape if length != 1])
        if labels.ndim != 2 or labels.dtype.kind not in "iu":
            raise ModelError(
                f"{self.name} is not a segmentation network: expected a map of labels or one score map per "
                f"label, got {output.dtype} of shape {output.shape}"
            )
        return labels


def open_masks(spec: str | Path | MaskPrior | None) -> MaskPrior | None:
    """The mask prior that `spec` names.

    Args:
        spec: a folder of masks, an ONNX file, "none" or None; "people" for the people and animals that the named
            network sees, "movable" for vehicles, too; a mask prior is returned as it is.

    Raises:
        InputError: `spec` is none of these.
        ModelError: the network cannot be found or loaded.
    """
    if spec is None or spec == "none":
        return None
    if not isinstance(spec, str | Path):
        if not isinstance(spec, MaskPrior):
            raise InputError(f"a mask prior must be callable with a frame, not {spec!r}")
        return spec
    if str(spec) in NAMED_MASKS:
        return MaskModel(_NAMED_NETWORK, labels=NAMED_MASKS[str(spec)])
    if Path(spec).suffix.lower() == ".onnx":
        return MaskModel(spec)
    if Path(spec).is_dir():
        return MaskFolder(spec)
    raise InputError(
        f"no masks {spec}: expected an existing folder of masks, an .onnx file, {', '.join(NAMED_MASKS)} or none"
    )


def _checked_margin(margin: float) -> float:
    if not 0.0 <= margin < 0.5:
        raise InputError(f"the margin of masks is a share of the image width from 0 to 0.5, not {margin}")
    return margin


def fitted(ignore: NDArray[np.bool_], frame: Frame, margin: float) -> NDArray[np.bool_]:
    """The mask in the size of the frame, grown by the margin (a share of the image width)."""
    height, width = frame.image.shape[:2]
    mask = ignore.astype(np.uint8)
    # Growing comes before resizing, because masks usually have fewer pixels than frames.
    radius = math.ceil(round(margin * width) * mask.shape[1] / width)
    if radius > 0:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        mask = cv2.dilate(mask, disc)
    mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    result: NDArray[np.bool_] = mask.astype(np.bool_)
    return result
