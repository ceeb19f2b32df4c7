"""Depth priors: what a network, or a folder of maps, says of the depth of one image."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorsfm.frames.folders import IMAGE_SUFFIXES
from factorsfm.frames.frame import Frame
from factorsfm.priors.models import MODELS, find_model
from factorsfm.priors.networks import Network, NetworkSpec, network_family
from factorsfm.support.errors import InputError, ModelError

logger = logging.getLogger(__name__)

# A depth edge: within a window of this share of the image width the inverse depth varies by more than
# EDGE_RANGE[1] of the map's own spread. Below EDGE_RANGE[0] it is ordinary slope.
EDGE_WINDOW = 0.015
EDGE_RANGE = (0.08, 0.25)
_MIN_RELATIVE_SPREAD = 0.02  # a map flatter than this, relative to its median, is noise and has no edges

_ASPECT_TOLERANCE = 0.02


class DepthKind(StrEnum):
    """What the values of a depth map are."""

    INVERSE = "inverse"  # inverse depth up to scale and shift, large = near
    DEPTH = "depth"  # depth along the optical axis, in a unit that cannot be trusted
    METRIC = "metric"  # depth along the optical axis, in metres


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth of one image, at its own resolution; it covers the whole image.

    Attributes:
        values: (h, w), kept as float32; NaN where there is no valid value (0, negative, infinite or NaN).
        kind: what the values are.

    Raises:
        InputError: `values` is not a 2-D array with at least one element, or `kind` is none.
    """

    values: NDArray[np.float32]
    kind: DepthKind

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.size == 0:
            raise InputError(f"a depth map must be a 2-D array, not one of shape {self.values.shape}")
        with np.errstate(over="ignore"):
            values = np.asarray(self.values, dtype=np.float32)
        valid = np.isfinite(values) & (values >= np.finfo(np.float32).tiny)  # below, 1 / value overflows
        object.__setattr__(self, "kind", _depth_kind(self.kind))
        object.__setattr__(self, "values", np.where(valid, values, np.float32(np.nan)))

    def inverse_depth(
        self, xy: ArrayLike, image_size: tuple[int, int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Inverse depth at keypoints, and how far each can be relied on.

        The map's values are interpolated bilinearly, and depths inverted after that.

        Args:
            xy: (n, 2) keypoints in pixels of the image, pixel centres at integers.
            image_size: (width, height) of the image.

        Returns:
            (n,) inverse depth, NaN where a neighbour that takes part is invalid or the point is outside the
            image; (n,) reliability in 0..1: 1 away from depth edges, 0 on them and where the depth is NaN.
        """
        values, reliability = self._look_up(xy, image_size)
        return (values if self.kind is DepthKind.INVERSE else 1.0 / values), reliability

    def depth(self, xy: ArrayLike, image_size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Depth at keypoints, and its reliability: as `inverse_depth`, for the domain of depth."""
        values, reliability = self._look_up(xy, image_size)
        return (1.0 / values if self.kind is DepthKind.INVERSE else values), reliability

    @cached_property
    def reliability(self) -> NDArray[np.float32]:
        """(h, w) in 0..1: 1 away from depth edges, 0 on them and where the map is invalid.

        The range (largest minus smallest) of the inverse depth in a window of `EDGE_WINDOW` of the image
        width is divided by the map's spread, the distance between the 5th and the 95th percentile of its
        inverse depth. The reliability falls linearly from 1 to 0 between the two `EDGE_RANGE` values of that
        ratio. Scale and shift of the inverse depth therefore do not matter, unless the map is nearly flat.
        """
        inverse = self.values if self.kind is DepthKind.INVERSE else np.float32(1.0) / self.values
        valid = np.isfinite(inverse)
        if not valid.any():
            return np.zeros(inverse.shape, dtype=np.float32)
        samples = inverse[valid]
        low, median, high = np.percentile(samples[:: 1 + samples.size // 100_000], (5, 50, 95))
        spread = max(high - low, _MIN_RELATIVE_SPREAD * median)
        side = max(3, 2 * round(EDGE_WINDOW * inverse.shape[1] / 2) + 1)
        window = np.ones((side, side), dtype=np.uint8)
        highest = cv2.dilate(np.where(valid, inverse, samples.min()), window)
        lowest = cv2.erode(np.where(valid, inverse, samples.max()), window)
        slope, edge = EDGE_RANGE
        reliability = np.clip((edge - (highest - lowest) / spread) / (edge - slope), 0.0, 1.0)
        return np.where(valid, reliability, 0.0).astype(np.float32)

    def _look_up(self, xy: ArrayLike, image_size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        size = np.array(image_size, dtype=np.float64)
        inside = np.all((points >= -0.5) & (points <= size - 0.5), axis=1)
        map_size = np.array(self.values.shape[::-1])
        # Rounded, so that a point on a map pixel does not reach for its neighbour by a rounding error.
        on_map = np.round((np.where(inside[:, None], points, 0.0) + 0.5) * (map_size / size) - 0.5, 6)
        on_map = np.clip(on_map, 0, map_size - 1)
        values = _bilinear(self.values, on_map)
        values[~inside] = np.nan
        reliability = _bilinear(self.reliability, on_map)
        reliability[~np.isfinite(values)] = 0.0
        return values, reliability


def _bilinear(array: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values at points inside the array; a NaN neighbour counts only where its weight is not zero."""
    height, width = array.shape
    x0, y0 = np.floor(xy).astype(np.intp).T
    fx, fy = (xy - np.floor(xy)).T
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    neighbours = np.array([array[y0, x0], array[y0, x1], array[y1, x0], array[y1, x1]], dtype=np.float64)
    result: NDArray[np.float64] = np.sum(weights * np.where(weights > 0, neighbours, 0.0), axis=0)
    return result


@runtime_checkable
class DepthPrior(Protocol):
    """Anything that says something about the depth of a frame."""

    @property
    def kind(self) -> DepthKind:
        """What the values of its maps are."""

    @property
    def name(self) -> str:
        """For reports and messages."""

    def __call__(self, frame: Frame) -> DepthMap | None:
        """The map of a frame, None where there is none."""


class DepthModel:
    """A monocular depth network in an ONNX file.

    Args:
        path_or_name: the file, or a named network such as "tcmonodepth".
        kind: what the network predicts. By default what the network is known for: inverse depth for
            TCMonoDepth, MiDaS, DPT and Depth Anything; depth for FastDepth, whose metres are trusted only
            where `DepthKind.METRIC` is asked for, since it learnt them from the rooms of one data set (NYU).
            A network that is not known is taken to predict inverse depth, which is logged.
        spec: how the network wants its image; guessed by default, see `Network`.

    Raises:
        ModelError: the network cannot be found, fetched, loaded or understood.
    """

    def __init__(
        self,
        path_or_name: str | Path,
        kind: DepthKind | str | None = None,
        spec: NetworkSpec | None = None,
    ) -> None:
        self._network = Network(find_model(path_or_name), spec)
        self.name = self._network.path.name
        self.kind = _default_model_kind(self._network.path) if kind is None else _depth_kind(kind)

    def __call__(self, frame: Frame) -> DepthMap:
        """The map of a frame.

        Raises:
            ModelError: the network fails on this frame or yields something else than one map.
        """
        output = self._network(frame.image)
        values = output.reshape([length for length in output.shape if length != 1])
        if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
            raise ModelError(
                f"{self.name} is not a depth network: expected one float map, got {output.dtype} of shape "
                f"{output.shape}"
            )
        return DepthMap(values, self.kind)


class DepthFolder:
    """A folder of depth maps, one file a frame; frames may lack one.

    Maps are .npy, .npz (its first array), .exr where OpenCV can read them, or 16-bit .png, in this order of
    preference where a folder holds several formats. A map belongs to the frame whose name it bears ("a.npy"
    or "a.jpg.npy" for "a.jpg"), else to the frame with its number: the last number in the frame's name, or
    the frame's index where the name has none. A map covers the whole image at any resolution.

    Args:
        path: the folder.
        kind: what the values are. By default depth for .png and inverse depth for the others, which is
            logged. A 16-bit PNG of kind metric is in millimetres.

    Attributes:
        asked, matched: how many frames were asked for, and how many of these had a map.

    Raises:
        InputError: the folder is missing, holds no map, or its format cannot be read here.
    """

    def __init__(self, path: str | Path, kind: DepthKind | str | None = None) -> None:
        self._files = FrameFiles(Path(path), (".npy", ".npz", ".exr", ".png"), "depth maps")
        self.name = Path(path).name
        self.asked = self.matched = 0
        suffix = self._files.suffix
        if suffix == ".exr" and not cv2.haveImageReader(str(self._files.first)):
            raise InputError(
                f"{self._files.first} cannot be read by this build of OpenCV; convert the maps to .npy or 16-bit .png"
            )
        if kind is None:
            self.kind = DepthKind.DEPTH if suffix == ".png" else DepthKind.INVERSE
            logger.warning("the %s maps in %s are taken as %s", suffix, path, _describe(self.kind))
        else:
            self.kind = _depth_kind(kind)

    def __call__(self, frame: Frame) -> DepthMap | None:
        """The map of a frame, None where the folder has none for it.

        Raises:
            InputError: the map cannot be read or has another aspect ratio than the frame.
        """
        self.asked += 1
        path = self._files.find(frame)
        if path is None:
            return None
        values = _read_map(path)
        check_aspect(values, frame, path)
        if self.kind is DepthKind.METRIC and path.suffix.lower() == ".png":
            values = values / 1000.0
        self.matched += 1
        return DepthMap(values, self.kind)


def open_depth(spec: str | Path | DepthPrior | None, kind: DepthKind | str | None = None) -> DepthPrior | None:
    """The depth prior that a user means.

    Args:
        spec: an ONNX file, a named network, a folder of maps, "none" or None; a prior is returned as it is.
        kind: what the values are, where that cannot be known.

    Raises:
        InputError: `spec` is none of these, or `kind` contradicts the prior given.
    """
    kind = None if kind is None else _depth_kind(kind)
    if spec is None or spec == "none":
        return None
    if not isinstance(spec, str | Path):
        if not isinstance(spec, DepthPrior):
            raise InputError(f"a depth prior must have a kind and a name and be callable, not {spec!r}")
        if kind is not None and kind is not spec.kind:
            raise InputError(f"the depth prior {spec.name} is of kind {spec.kind}, not {kind}")
        return spec
    if str(spec) in MODELS or Path(spec).suffix.lower() == ".onnx":
        return DepthModel(spec, kind)
    if Path(spec).is_dir():
        return DepthFolder(spec, kind)
    raise InputError(
        f"no depth prior {spec}: expected an existing folder of depth maps, an .onnx file, "
        f"a named network ({', '.join(MODELS)}) or none"
    )


class FrameFiles:
    """The files of a folder that belong to frames, found by name first and by number second.

    Only files with the first of `suffixes` that occurs in the folder count.

    Raises:
        InputError: the folder is missing or holds no such file.
    """

    def __init__(self, folder: Path, suffixes: Sequence[str], what: str) -> None:
        if not folder.is_dir():
            raise InputError(f"there is no folder {folder} of {what}")
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
        present = {path.suffix.lower() for path in files}
        suffix = next((suffix for suffix in suffixes if suffix in present), None)
        if suffix is None:
            raise InputError(f"the folder {folder} holds no {what} ({', '.join(suffixes)})")
        files = [path for path in files if path.suffix.lower() == suffix]
        self.suffix = suffix
        self.first = files[0]
        self._by_name: dict[str, Path] = {}
        by_number: dict[int, list[Path]] = {}
        for path in files:
            self._by_name[path.stem] = path
        for path in files:
            stem = image_stem(path.stem)
            self._by_name.setdefault(stem, path)
            if (number := _last_number(stem)) is not None:
                by_number.setdefault(number, []).append(path)
        self._by_number = {number: paths[0] for number, paths in by_number.items() if len(paths) == 1}

    def find(self, frame: Frame) -> Path | None:
        """The frame's file, or None."""
        stem = image_stem(frame.name)
        for name in (frame.name, stem):
            if name in self._by_name:
                return self._by_name[name]
        number = _last_number(stem)
        return self._by_number.get(frame.index if number is None else number)


def image_stem(name: str) -> str:
    """File name without the suffix of an image format: "a.0001.png" -> "a.0001", "a.0001" unchanged."""
    return Path(name).stem if Path(name).suffix.lower() in IMAGE_SUFFIXES else name


def check_aspect(array: NDArray[Any], frame: Frame, path: Path) -> None:
    """Refuse a map whose aspect ratio is not the frame's (InputError)."""
    (height, width), (frame_height, frame_width) = array.shape[:2], frame.image.shape[:2]
    if abs(width * frame_height / (height * frame_width) - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(
            f"{path} is {width}x{height} and its frame {frame_width}x{frame_height}: the aspect ratios must agree"
        )


def _last_number(stem: str) -> int | None:
    numbers = re.findall(r"\d+", stem)
    return int(numbers[-1]) if numbers else None


def _read_map(path: Path) -> NDArray[Any]:
    try:
        values = _read_array(path)
    except Exception as error:  # damaged files raise a dozen kinds in numpy and zipfile
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


def _depth_kind(kind: DepthKind | str) -> DepthKind:
    try:
        return DepthKind(kind)
    except ValueError:
        raise InputError(f"no depth kind {kind!r}: expected {', '.join(DepthKind)}") from None


def _default_model_kind(path: Path) -> DepthKind:
    family = network_family(path)
    kind = DepthKind.DEPTH if family == "fastdepth" else DepthKind.INVERSE
    if family is None:
        logger.warning("%s is not a known depth network: its output is taken as %s", path.name, _describe(kind))
    return kind


def _describe(kind: DepthKind) -> str:
    meaning = "large = near" if kind is DepthKind.INVERSE else "large = far"
    return f"{kind} ({meaning}); say which kind it is (--depth-kind) if that is wrong"
