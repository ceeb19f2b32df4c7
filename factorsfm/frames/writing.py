"""Image files out."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.errors import InputError

FAST_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def write_image(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16], options: Sequence[int] = ()) -> None:
    """Write (h, w, 3) BGR or (h, w) in the format of the suffix; what is at the path is replaced.

    Args:
        options: of `cv2.imencode`.

    Raises:
        InputError: the suffix is that of no format that can be written.
        OSError: the file cannot be written.
    """
    try:
        _, data = cv2.imencode(path.suffix, image, options)
    except cv2.error as error:
        raise InputError(f"the image {path.name} cannot be written: no known format ends in {path.suffix!r}") from error
    path.write_bytes(data.tobytes())  # not by OpenCV, which does not say why it cannot write


def write_exr(path: Path, image: NDArray[np.floating]) -> None:
    """Write (h, w, 3) RGB in linear light, half or float as the array is.

    Raises:
        OSError: the file cannot be written.
    """
    openexr = import_module("OpenEXR")  # here, since few commands write EXR
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    try:
        with openexr.File(header, {"RGB": np.ascontiguousarray(image)}) as file:
            file.write(str(path))
    except RuntimeError as error:
        raise OSError(str(error)) from error
