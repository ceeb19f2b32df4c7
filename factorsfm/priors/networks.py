"""Image networks in ONNX files: what input they expect, and running them."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from factorsfm.priors.models import named_model
from factorsfm.support.errors import ModelError

logger = logging.getLogger(__name__)

Layout = Literal["NCHW", "NHWC"]

_INTERPOLATIONS = {"area": cv2.INTER_AREA, "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


@dataclass(frozen=True, slots=True)
class NetworkSpec:
    """The input that a network expects: ``(pixel * value_max / 255 - mean) / std``.

    Attributes:
        layout: order of the input's axes.
        color: order of the channels.
        value_max: value of a white pixel before `mean` and `std` are applied (1 or 255).
        mean, std: per channel in the order of `color`, on the scale of `value_max`.
        size: (height, width) of the input, None if the network takes any size.
        free_height: height of the input if `size` is None; the width follows from the aspect ratio of the image.
        multiple_of: height and width are rounded to a multiple of this if `size` is None.
        interpolation: "area", "linear" or "cubic"; "area" becomes "linear" if the image is enlarged.

    Raises:
        ModelError: a value is not among these choices.
    """

    layout: Layout = "NCHW"
    color: Literal["RGB", "BGR"] = "RGB"
    value_max: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    size: tuple[int, int] | None = None
    free_height: int = 384
    multiple_of: int = 32
    interpolation: Literal["area", "linear", "cubic"] = "area"

    def __post_init__(self) -> None:
        if self.layout not in ("NCHW", "NHWC"):
            raise ModelError(f"layout must be NCHW or NHWC, not {self.layout!r}")
        if self.color not in ("RGB", "BGR"):
            raise ModelError(f"color must be RGB or BGR, not {self.color!r}")
        if self.interpolation not in _INTERPOLATIONS:
            raise ModelError(f"interpolation must be area, linear or cubic, not {self.interpolation!r}")
        if len(self.mean) != 3 or len(self.std) != 3 or min(self.std) <= 0 or self.value_max <= 0:
            raise ModelError(
                "mean and std must hold three numbers, std and value_max positive ones, not "
                f"mean={self.mean}, std={self.std}, value_max={self.value_max}"
            )
        lengths = (self.free_height, self.multiple_of, *(self.size or (1, 1)))
        if len(lengths) != 4 or min(lengths) < 1:
            raise ModelError(
                f"size must be (height, width) and all lengths positive, not size={self.size}, "
                f"free_height={self.free_height}, multiple_of={self.multiple_of}"
            )


IMAGENET = NetworkSpec(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))

NETWORK_SPECS: dict[str, NetworkSpec] = {
    "tcmonodepth": NetworkSpec(value_max=255.0, size=(192, 320)),
    "depth_anything": replace(IMAGENET, free_height=518, multiple_of=14, interpolation="cubic"),
    "fastdepth": NetworkSpec(layout="NHWC", size=(224, 224)),
    "deeplab": NetworkSpec(layout="NHWC", value_max=255.0, mean=(128.0,) * 3, std=(128.0,) * 3, size=(513, 513)),
    "dpt": NetworkSpec(mean=(0.5,) * 3, std=(0.5,) * 3, interpolation="cubic"),
    "midas": replace(IMAGENET, free_height=256, interpolation="cubic"),
}

# Tried in this order, because DPT networks are often named "midas_..._dpt_..." and need the normalisation of DPT.
_FAMILY_PATTERNS = {
    "tcmonodepth": r"tc-?monodepth|tcsmallnet",
    "depth_anything": r"depth-?anything",
    "fastdepth": r"fast-?depth",
    "deeplab": r"deeplab",
    "dpt": r"(?<![a-z])dpt",
    "midas": r"midas",
}


def network_family(path: Path) -> str | None:
    """Key of `NETWORK_SPECS` for a file, None if the network is unknown.

    The file name contains the key in some spelling ("Depth-Anything-v2" gives depth_anything), or the checksum is that
    of a named network.
    """
    name = re.sub(r"[-_. ]+", "-", path.stem.lower())
    by_name = (family for family, pattern in _FAMILY_PATTERNS.items() if re.search(pattern, name))
    return next(by_name, None) or named_model(path)


class Network:
    """An ONNX network that takes one image, run on the CPU.

    Args:
        path: the file.
        spec: the input that it expects. By default that of its family (`network_family`), or ImageNet normalisation for
            an unknown network, with the layout and the fixed size of the network's own input.

    Attributes:
        path: the file.
        spec: the input that it expects.

    Raises:
        ModelError: the file is missing or not an ONNX network; it does not take one image (a single 4-D float input
            with three channels, batch 1); or it contradicts `spec`.
    """

    def __init__(self, path: str | Path, spec: NetworkSpec | None = None) -> None:
        self.path = Path(path)
        self._session = open_session(self.path)
        self._input, shape = _image_input(self._session, self.path)
        self._dtype = _INPUT_TYPES[self._input.type]
        self.spec = _guessed_spec(self.path, shape) if spec is None else _checked_spec(spec, self.path, shape)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """The network's first output for a BGR (h, w, 3) image, in the network's own shape and type.

        Raises:
            ModelError: the network fails on this input.
        """
        values = self.preprocess(image)
        try:
            output: NDArray[Any] = self._session.run(None, {self._input.name: values})[0]
        except Exception as error:  # the exceptions of onnxruntime have no common root
            height, width = self.input_size(image.shape[0], image.shape[1])
            raise ModelError(f"the network {self.path.name} fails on an input of {width}x{height}") from error
        return output

    def input_size(self, height: int, width: int) -> tuple[int, int]:
        """(height, width) of the network's input for an image of this size."""
        if self.spec.size is not None:
            return self.spec.size
        step = self.spec.multiple_of
        input_height = max(1, round(self.spec.free_height / step)) * step
        return input_height, max(1, round(input_height * width / height / step)) * step

    def preprocess(self, image: NDArray[np.uint8]) -> NDArray[np.floating[Any]]:
        """The network's input, with batch axis, for a BGR (h, w, 3) image."""
        height, width = self.input_size(image.shape[0], image.shape[1])
        interpolation = _INTERPOLATIONS[self.spec.interpolation]
        if self.spec.interpolation == "area" and (height > image.shape[0] or width > image.shape[1]):
            interpolation = cv2.INTER_LINEAR
        resized = cv2.resize(image, (width, height), interpolation=interpolation)
        if self.spec.color == "RGB":
            resized = cv2.cvtColor(resized, cv2.COLOR_BGR2RGB)
        gain = (self.spec.value_max / 255.0 / np.array(self.spec.std)).astype(np.float32)
        offset = (np.array(self.spec.mean) / np.array(self.spec.std)).astype(np.float32)
        if self.spec.layout == "NCHW":  # splitting planes of bytes takes a fifth of the time that floats take
            resized, gain, offset = np.stack(cv2.split(resized)), gain[:, None, None], offset[:, None, None]
        return np.ascontiguousarray((resized * gain - offset)[np.newaxis], dtype=self._dtype)


def open_session(path: Path) -> Any:
    """An onnxruntime session on the CPU.

    Raises:
        ModelError: the file is missing or not an ONNX network.
    """
    if not path.is_file():
        raise ModelError(f"there is no network file {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = min(2, cv2.getNumThreads())  # one if the process is limited to one thread
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # the cores have other work between frames
    options.log_severity_level = 4  # fatal only: failures raise exceptions
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the exceptions of onnxruntime have no common root
        raise ModelError(f"{path} is not an ONNX network that onnxruntime can load") from error


def _image_input(session: Any, path: Path) -> tuple[Any, list[int | None]]:
    """The network's only input and its shape, with None for a free axis."""
    inputs = session.get_inputs()
    shape = [length if isinstance(length, int) else None for length in inputs[0].shape] if inputs else []
    one_image = len(shape) == 4 and shape[0] in (1, None) and bool(_layouts(shape))
    if len(inputs) == 1 and inputs[0].type in _INPUT_TYPES and one_image:
        return inputs[0], shape
    found = ", ".join(f"{i.name} {i.type}{i.shape}" for i in inputs) or "none"
    raise ModelError(
        f"{path.name} is not an image network: expected one 4-D float input with 3 channels and batch 1, found {found}"
    )


def _layouts(shape: list[int | None]) -> list[Layout]:
    """Layouts that the shape of the input allows; those with a fixed channel count come first."""
    channels: dict[Layout, int | None] = {"NCHW": shape[1], "NHWC": shape[3]}
    return [layout for wanted in (3, None) for layout, count in channels.items() if count == wanted]


def _image_axes(shape: list[int | None], layout: Layout) -> tuple[int | None, int | None]:
    """Height and width of the input, None where free."""
    return (shape[2], shape[3]) if layout == "NCHW" else (shape[1], shape[2])


def _guessed_spec(path: Path, shape: list[int | None]) -> NetworkSpec:
    family = network_family(path)
    if family is None:
        logger.warning(
            "%s is not a known network: it gets RGB with ImageNet normalisation; pass a NetworkSpec if that is wrong",
            path.name,
        )
    spec = IMAGENET if family is None else NETWORK_SPECS[family]
    layouts = _layouts(shape)
    layout = layouts[0] if 3 in (shape[1], shape[3]) or spec.layout not in layouts else spec.layout
    height, width = _image_axes(shape, layout)
    if height is not None and width is not None:
        return replace(spec, layout=layout, size=(height, width))
    return replace(spec, layout=layout)


def _checked_spec(spec: NetworkSpec, path: Path, shape: list[int | None]) -> NetworkSpec:
    if spec.layout not in _layouts(shape):
        raise ModelError(f"the spec of {path.name} says {spec.layout}, and the network's input is {shape}")
    height, width = _image_axes(shape, spec.layout)
    if spec.size is None and height is not None and width is not None:
        return replace(spec, size=(height, width))
    if spec.size is not None and (height or spec.size[0], width or spec.size[1]) != spec.size:
        raise ModelError(
            f"the spec of {path.name} says height and width {spec.size}, and the network takes {(height, width)}"
        )
    return spec
