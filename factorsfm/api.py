"""The one call: from a source of frames to a finished reconstruction."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera import guess_camera
from factorsfm.errors import InputError
from factorsfm.frames import Frame, read_frames
from factorsfm.options import Options
from factorsfm.priors.depth import DepthFolder, DepthKind, DepthPrior, open_depth
from factorsfm.priors.masks import MaskFolder, MaskPrior, open_masks
from factorsfm.reconstruction import Reconstruction
from factorsfm.stream import Stream

Progress = Callable[[str, int, int | None], None]


def reconstruct(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]],
    *,
    camera: pycolmap.Camera | None = None,
    depth: str | Path | DepthPrior | None = "tcmonodepth",
    depth_kind: DepthKind | str | None = None,
    masks: str | Path | MaskPrior | None = None,
    frames: slice | None = None,
    preset: str = "default",
    progress: Progress | None = None,
) -> Reconstruction:
    """Camera path, lens and sparse points of one shot.

    Args:
        source: a video file, a folder of images, or any iterable of 8-bit images (BGR or grey) or `Frame`s.
        camera: the lens; None takes EXIF or a guess and refines the focal length where the shot determines it.
        depth: a network (ONNX file), a named model, a folder of maps, any `DepthPrior`, or None.
        depth_kind: what the prior holds, where it cannot be known.
        masks: a folder, a segmentation network, any `MaskPrior`, or None.
        frames: range of the source's frames.
        preset: see `options.PRESETS`.
        progress: called with the stage, the frames done, and their number where it is known.

    Raises:
        InputError: the source, the camera or a prior cannot be used.
        ReconstructionError: the shot cannot be reconstructed.
    """
    begin = time.perf_counter()
    options = Options.preset_named(preset)
    prior = open_depth(depth, depth_kind) if options.uses_depth else None
    mask_prior = open_masks(masks)
    iterator = read_frames(source, frames)
    if camera is None:
        options = replace(options, refine_focal_length=True)
    stream: Stream | None = None
    for done, frame in enumerate(iterator):
        if stream is None:
            if camera is None:
                camera = _guessed_camera(source, frame)
            stream = Stream(camera, depth=prior, masks=mask_prior, options=options)
        if progress is not None:
            progress("frames", done, None)
        stream.push(frame)
    if stream is None:
        raise InputError(f"no frames in {source}")
    for name, folder in (("depth map", prior), ("mask", mask_prior)):
        if isinstance(folder, DepthFolder | MaskFolder) and folder.asked and not folder.matched:
            raise InputError(f"no {name} in the given folder matches a frame of {source}")
    result = stream.finish(progress)
    result.seconds["total"] = time.perf_counter() - begin
    result.options["source"] = str(source) if isinstance(source, str | Path) else "frames"
    return result


def _guessed_camera(source: object, frame: Frame) -> pycolmap.Camera:
    """EXIF of the first image of a folder, else the documented guess."""
    height, width = frame.image.shape[:2]
    image = Path(source) / frame.name if isinstance(source, str | Path) and Path(source).is_dir() else None
    return guess_camera(width, height, image)
