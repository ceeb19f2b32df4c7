"""Depth priors: a depth map for each frame, from a network or from files."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth_map import DepthKind, DepthMap, depth_kind
from factorsfm.priors.frame_folder import FrameFolder, check_aspect
from factorsfm.priors.models import MODELS, find_model
from factorsfm.priors.networks import Network, NetworkSpec, network_family
from factorsfm.support.errors import InputError, ModelError

logger = logging.getLogger(__name__)


@runtime_checkable
class DepthPrior(Protocol):
    """A callable that gives the depth map of a frame."""

    @property
    def kind(self) -> DepthKind:
        """What the values of its maps are."""

    @property
    def name(self) -> str:
        """Its name in reports and messages."""

    def __call__(self, frame: Frame) -> DepthMap | None:
        """The map of a frame, None if it has none."""


class DepthModel:
    """A monocular depth network in an ONNX file.

    Args:
        path_or_name: the file, or a named network such as "tcmonodepth".
        kind: what the network predicts. The default is inverse depth for TCMonoDepth, MiDaS, DPT and Depth Anything,
            and depth for FastDepth: it learned its metres from the rooms of one data set (NYU), so they count only if
            `DepthKind.METRIC` is asked for. An unknown network is taken to predict inverse depth, with a warning.
        spec: how the network expects its image; guessed by default, see `Network`.

    Attributes:
        kind: what the network predicts.

    Raises:
        ModelError: the network cannot be found, fetched or loaded, or does not take one image.
    """

    def __init__(
        self,
        path_or_name: str | Path,
        kind: DepthKind | str | None = None,
        spec: NetworkSpec | None = None,
    ) -> None:
        self._network = Network(find_model(path_or_name), spec)
        self.name = self._network.path.name
        self.kind = _default_model_kind(self._network.path) if kind is None else depth_kind(kind)

    def __call__(self, frame: Frame) -> DepthMap:
        """The map of a frame.

        Raises:
            ModelError: the network fails on this frame, or gives something else than one map.
        """
        output = self._network(frame.image)
        values = output.reshape([length for length in output.shape if length != 1])
        if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
            raise ModelError(
                f"{self.name} is not a depth network: expected one float map, got {output.dtype} of shape "
                f"{output.shape}"
            )
        return DepthMap(values, self.kind)


class DepthFolder(FrameFolder):
    """A folder of depth maps, one file per frame; frames may lack one.

    Maps are .npy, .npz (its first array), .exr where OpenCV can read them, or 16-bit .png; where a folder holds several
    formats, the first of these counts. A map belongs to the frame whose name it bears ("a.npy" or "a.jpg.npy" for
    "a.jpg"), otherwise to the frame with its number: the last number in the frame's name, or the frame's index if the
    name has none. A map covers the whole image at any resolution.

    Args:
        path: the folder.
        kind: what the values are; by default depth for .png and inverse depth for the others, with a warning. A 16-bit
            PNG of kind metric is in millimetres.

    Attributes:
        kind: what the values are.
        asked, matched: number of frames whose map was asked for, and of those among them that have one.

    Raises:
        InputError: the folder does not exist, holds no map, or its format cannot be read here.
    """

    def __init__(self, path: str | Path, kind: DepthKind | str | None = None) -> None:
        super().__init__(Path(path), (".npy", ".npz", ".exr", ".png"), "depth maps")
        if self.suffix == ".exr" and not cv2.haveImageReader(str(self._first)):
            raise InputError(
                f"{self._first} cannot be read by this build of OpenCV; convert the maps to .npy or 16-bit .png"
            )
        if kind is None:
            self.kind = DepthKind.DEPTH if self.suffix == ".png" else DepthKind.INVERSE
            logger.warning("the %s maps in %s are taken as %s", self.suffix, path, _describe(self.kind))
        else:
            self.kind = depth_kind(kind)

    def __call__(self, frame: Frame) -> DepthMap | None:
        """The map of a frame, None if the folder has none for it.

        Raises:
            InputError: the map cannot be read, or has another aspect ratio than the frame.
        """
        path = self.file_of(frame)
        if path is None:
            return None
        values = _read_map(path)
        check_aspect(values, frame, path)
        if self.kind is DepthKind.METRIC and path.suffix.lower() == ".png":
            values = values / 1000.0
        return DepthMap(values, self.kind)


def open_depth(spec: str | Path | DepthPrior | None, kind: DepthKind | str | None = None) -> DepthPrior | None:
    """The depth prior that `spec` names.

    Args:
        spec: an ONNX file, a named network, a folder of maps, "none" or None; a prior is returned as it is.
        kind: what the values are; None is the default of the network or folder.

    Raises:
        InputError: `spec` is none of these, or `kind` contradicts the given prior.
    """
    kind = None if kind is None else depth_kind(kind)
    if spec is None or spec == "none":
        return None
    if not isinstance(spec, str | Path):
        if not isinstance(spec, DepthPrior):
            raise InputError(f"a depth prior must have a kind and a name and be callable, not {spec!r}")
        if kind is not None and kind is not spec.kind:
            raise InputError(f"the depth prior {spec.name} is of kind {spec.kind}, not {kind}")
        return spec
    named = [name for name, model in MODELS.items() if model.gives == "depth"]
    if str(spec) in named or Path(spec).suffix.lower() == ".onnx":
        return DepthModel(spec, kind)
    if Path(spec).is_dir():
        return DepthFolder(spec, kind)
    raise InputError(
        f"no depth prior {spec}: expected an existing folder of depth maps, an .onnx file, "
        f"a named network ({', '.join(named)}) or none"
    )


def _read_map(path: Path) -> NDArray[Any]:
    try:
        values = _read_array(path)
    except Exception as error:  # numpy and zipfile raise many kinds of errors on damaged files
        raise InputError(f"the depth map {path} cannot be read") from error
    if values.dtype == np.uint8 and path.suffix.lower() == ".png":
        raise InputError(f"the depth map {path} has 8 bits a pixel, too few for depth; expected a 16-bit PNG")
    shape = values.shape
    values = values.reshape([length for length in shape if length != 1]) if values.ndim > 2 else values
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise InputError(
            f"the depth map {path} must hold one 2-D array of numbers, not {values.dtype} of shape {shape}"
        )
    return values


def _read_array(path: Path) -> NDArray[Any]:
    if path.suffix.lower() == ".npy":
        return np.asarray(np.load(path, allow_pickle=False))
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return np.asarray(archive[next(iter(archive.files))])
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"OpenCV reads no image from {path}")
    return np.asarray(image)


def _default_model_kind(path: Path) -> DepthKind:
    family = network_family(path)
    kind = DepthKind.DEPTH if family == "fastdepth" else DepthKind.INVERSE
    if family is None:
        logger.warning("%s is not a known depth network: its output is taken as %s", path.name, _describe(kind))
    return kind


def _describe(kind: DepthKind) -> str:
    meaning = "large = near" if kind is DepthKind.INVERSE else "large = far"
    return f"{kind} ({meaning}); say which kind it is (--depth-kind) if that is wrong"
