"""Plates of film: EXR and DPX files as the numbers that they hold."""

from __future__ import annotations

import io
import struct
from importlib import import_module
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.aspect import stated_or_square
from factorsfm.frames.silence import dropped_if_it_fails
from factorsfm.support.errors import InputError

Pixels = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float16] | NDArray[np.float32]

PLATE_SUFFIXES = frozenset({".exr", ".dpx"})
_MOST_PIXELS = 2**30  # of a display window, as OpenCV allows them; a damaged header may ask for more than memory holds
_DPX_ASPECT, _DPX_UNSET = slice(1628, 1636), 2**32 - 1  # SMPTE 268: two integers, horizontal and vertical
_LINEAR = 8  # transfer characteristic "linear" of ITU-T H.273, by which FFmpeg reports that of a DPX header
_FLAT_PARTS = ("scanlineimage", "tiledimage")  # deep parts hold samples in depth, which have to be composited first


def read_exr(path: Path) -> Pixels:
    """The display window of an EXR file as (h, w, 3) BGR in linear light, half or float as in the file.

    Where the data window is smaller the rest is black; what lies outside the display window (overscan) is left out, so
    that all frames of a sequence have one size. The colours are R, G and B; without them Y; without that the layer
    whose name is first in the alphabet among those with R, G and B.

    Raises:
        InputError: the file is damaged, or holds no colours.
    """
    openexr = import_module("OpenEXR")  # here, since most sources are no plates
    try:
        with dropped_if_it_fails(), openexr.File(str(path)) as file:
            # `channels` is a view into the file object: what is used of it is copied below, before the file is closed.
            parts = [(part.header, part.channels) for part in file.parts]
            header, colors = _colors(parts, path)
            return _in_display_window(colors, header, path)
    except (RuntimeError, ValueError, TypeError) as error:
        reason = str(error).strip().splitlines()
        raise InputError(f"image {path} cannot be decoded as EXR: {reason[0] if reason else 'damaged'}") from error


def _colors(parts: list[tuple[dict[str, Any], dict[str, Any]]], path: Path) -> tuple[dict[str, Any], Pixels]:
    """Header and (h, w, 3) RGB of the data window, from the first part that has colours."""
    for header, channels in parts:
        if str(header.get("type", _FLAT_PARTS[0])).rpartition(".")[2] not in _FLAT_PARTS:
            continue
        layers = sorted(name for name, channel in channels.items() if channel.pixels.shape[2:] in ((3,), (4,)))
        for name in (*(name for name in ("RGB", "RGBA") if name in channels), "Y", *layers):
            if name in channels:
                pixels = channels[name].pixels
                colors = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., :3]
                if colors.dtype.kind == "f":
                    return header, colors
    found = sorted(name for _, channels in parts for name in channels)
    if not found:
        raise ValueError("it is damaged or truncated")  # OpenEXR reads such a file as one without channels
    raise InputError(f"image {path} has no colours R, G, B or Y of half or float; it holds {', '.join(found[:5])}")


def _in_display_window(colors: Pixels, header: dict[str, Any], path: Path) -> Pixels:
    """(h, w, 3) BGR of the display window from RGB of the data window."""
    (left, top), (right, bottom) = (np.asarray(corner, np.int64) for corner in header["displayWindow"])
    width, height = int(right - left + 1), int(bottom - top + 1)
    if not (width > 0 and height > 0 and width * height <= _MOST_PIXELS):
        raise InputError(f"image {path} has a display window of {width}x{height} pixels; it is damaged")
    x, y = (int(start) for start in np.asarray(header["dataWindow"][0], np.int64) - (left, top))
    window = np.zeros((height, width, 3), colors.dtype)
    part = colors[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0), ::-1]
    window[max(y, 0) : max(y, 0) + part.shape[0], max(x, 0) : max(x, 0) + part.shape[1]] = part
    return window


def plate_pixel_aspect(path: Path) -> float:
    """Width of a pixel over its height, as the header of an EXR or DPX file says; 1 if it says nothing that
    pixels can have.

    Raises:
        InputError: the file is damaged.
    """
    if path.suffix.lower() == ".exr":
        openexr = import_module("OpenEXR")
        try:
            with dropped_if_it_fails(), openexr.File(str(path), header_only=True) as file:
                aspect = float(file.parts[0].header.get("pixelAspectRatio", 1.0))
        except (RuntimeError, ValueError, TypeError) as error:
            raise InputError(f"image {path} cannot be decoded as EXR: damaged") from error
    else:
        try:
            with path.open("rb") as file:
                header = file.read(_DPX_ASPECT.stop)
        except OSError as error:
            raise InputError(f"image {path} cannot be read: {error.strerror}") from error
        order = ">" if header.startswith(b"SDPX") else "<"
        across, down = struct.unpack(f"{order}2I", header[_DPX_ASPECT].ljust(8, b"\xff"))
        aspect = across / down if down not in (0, _DPX_UNSET) and across != _DPX_UNSET else 1.0
    return stated_or_square(aspect, path)


def read_dpx(data: bytes, path: Path) -> Pixels:
    """A DPX file of 8 to 16 bits as (h, w, 3) BGR: uint16 over its full range, or float32 if its header says linear.

    Args:
        path: for the messages. FFmpeg is given the bytes, since it takes "%04d" in a name for a pattern.

    Raises:
        InputError: the file is damaged, or has a layout that FFmpeg does not know.
    """
    try:
        with av.open(io.BytesIO(data), mode="r", format="dpx_pipe") as file:
            frame = next(file.decode(video=0))
            pixels = frame.to_ndarray(format="bgr48le")
    except (av.FFmpegError, StopIteration, ValueError) as error:
        raise InputError(f"image {path} cannot be decoded as DPX; it is damaged or not one") from error
    if int(frame.color_trc) == _LINEAR:
        return np.asarray(pixels / np.float32(65535), np.float32)
    return np.asarray(pixels, np.uint16)
