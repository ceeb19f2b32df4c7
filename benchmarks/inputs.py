"""The inputs of a cell: the shot, its frames in the variant, and the depth prior.

A data folder holds sets one level down, such as ``DATA/studiosim/d01``; `evaluation.readers.read_shot` says what a set
holds.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.plan import (
    AS_SET,
    CRF_30,
    DEGRADED,
    DRAWS,
    FEW,
    FIRST_10,
    FIRST_20,
    FULL,
    NO_PRIOR,
    drawn,
    undrawn,
)
from factorsfm import DepthFolder, DepthKind, DepthMap, DepthModel, DepthPrior, Frame, InputError, read_frames
from factorsfm.evaluation.degrade import degraded_frames
from factorsfm.evaluation.readers import read_shot
from factorsfm.evaluation.truth import DepthLookup, Shot
from factorsfm.evaluation.useless_priors import ImageRowPrior, RandomSmoothPrior

_CENTIMETRES = ("tsukuba-",)  # beginnings of the names of sets whose true translations are in centimetres
_FAINT_NOISE = 0.5  # standard deviation in grey levels: no eye sees it
NETWORK_FILES = {
    "tcmonodepth": "tcmonodepth_tcsmallnet_192x320.onnx",
    "fastdepth": "fast_depth_224_fp32.onnx",
}


@dataclass(frozen=True, slots=True)
class Variant:
    """A change of the input or of the tracker.

    Attributes:
        frames: number of the first frames that are used; None for all.
        max_tracks: as in `TrackerOptions`; None for its default.
    """

    frames: int | None = None
    max_tracks: int | None = None


VARIANTS = {
    FULL: Variant(),
    FIRST_10: Variant(frames=10),
    FIRST_20: Variant(frames=20),
    FEW: Variant(max_tracks=40),
    DEGRADED: Variant(frames=30),
    CRF_30: Variant(frames=30),
    AS_SET: Variant(),
}
VARIANTS |= {drawn(name, draw): variant for name, variant in VARIANTS.items() for draw in DRAWS}


def shot_folder(data: Path, name: str) -> Path:
    """The folder of a set.

    Raises:
        InputError: there is none.
    """
    found = sorted(data.glob(f"*/{name}"))
    if not found:
        raise InputError(f"there is no set {name} in {data}")
    return found[0]


def open_shot(data: Path, name: str, variant: str) -> Shot:
    """The shot, with the truth of the frames of the variant."""
    shot = read_shot(shot_folder(data, name), unit=0.01 if name.startswith(_CENTIMETRES) else 1.0)
    frames = VARIANTS[variant].frames
    if frames is None:
        return shot
    keep = shot.indices < frames
    return replace(shot, indices=shot.indices[keep], rotations=shot.rotations[keep], centers=shot.centers[keep])


def open_frames(shot: Shot, variant: str) -> Iterator[Frame]:
    """The frames of the variant."""
    frames = islice(shot.frames(), VARIANTS[variant].frames)
    name, draw = undrawn(variant)
    if draw:
        frames = (_with_faint_noise(frame, draw) for frame in frames)
    if name == DEGRADED:
        return degraded_frames(frames)
    if name == CRF_30:
        return compressed_frames(frames, crf=30)
    return frames


def _with_faint_noise(frame: Frame, draw: int) -> Frame:
    noise = np.random.default_rng([draw, frame.index]).normal(0.0, _FAINT_NOISE, frame.image.shape)
    return replace(frame, image=np.clip(np.round(frame.image + noise), 0, 255).astype(np.uint8))


def compressed_frames(frames: Iterable[Frame], crf: int) -> Iterator[Frame]:
    """The frames after H.264 compression at a constant rate factor; needs the package imageio-ffmpeg."""
    import imageio_ffmpeg

    originals = list(frames)
    height, width = originals[0].image.shape[:2]
    with tempfile.TemporaryDirectory(prefix="crf-") as folder:
        video = Path(folder) / "shot.mp4"
        writer = imageio_ffmpeg.write_frames(
            str(video),
            (width, height),
            pix_fmt_in="bgr24",
            fps=24,
            codec="libx264",
            macro_block_size=2,
            output_params=["-crf", str(crf)],
        )
        writer.send(None)
        for frame in originals:
            writer.send(np.ascontiguousarray(frame.image))
        writer.close()
        for frame, compressed in zip(originals, read_frames(video), strict=True):
            yield replace(frame, image=compressed.image)


class TrueDepthPrior:
    """True or sensor depth D with multiplicative noise, ``D (1 + alpha n)``; n is standard normal for each pixel."""

    def __init__(self, depth: DepthLookup, kind: DepthKind, alpha: float = 0.0) -> None:
        self.kind, self.name = kind, f"true depth, noise {alpha}"
        self._depth, self._alpha = depth, alpha

    def __call__(self, frame: Frame) -> DepthMap | None:
        depth: NDArray[np.float32] | None = self._depth(frame.index)
        if depth is None:
            return None
        noise = np.random.default_rng(frame.index).standard_normal(depth.shape, np.float32)
        return DepthMap(depth * (1.0 + np.float32(self._alpha) * noise), self.kind)


def open_prior(name: str, shot: Shot, data: Path, models: Path, cache: Path) -> DepthPrior | None:
    """The prior of this name: a network, `simulated`, `sensor`, `image-row`, `random-field`, `noise-ALPHA` or `none`.

    Raises:
        InputError: no such prior.
    """
    if name == NO_PRIOR:
        return None
    if name in NETWORK_FILES:
        return DepthModel(models / NETWORK_FILES[name])
    if name == "simulated":
        return DepthFolder(simulated_prior(shot.name, data, cache), DepthKind.INVERSE)
    if name == "sensor":
        return TrueDepthPrior(shot.depth, DepthKind.METRIC)
    if name == "image-row":
        return ImageRowPrior()
    if name == "random-field":
        return RandomSmoothPrior()
    if name.startswith("noise-"):
        # As depth in an unknown unit, as the paper's priors have it.
        return TrueDepthPrior(shot.depth, DepthKind.DEPTH, float(name.removeprefix("noise-")))
    raise InputError(f"unknown prior {name}")


def simulated_prior(name: str, data: Path, cache: Path) -> Path:
    """The folder of the simulated prior of a shot; a script in the data folder makes it once."""
    folder = cache / "simulated" / name
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            made = Path(scratch) / "maps"
            script = [sys.executable, str(data / "simulate_prior.py"), str(shot_folder(data, name)), str(made)]
            subprocess.run(script, check=True, stdout=subprocess.DEVNULL)
            settle(made, folder)
    return folder


def settle(made: Path, folder: Path) -> None:
    """Move a finished folder to its place, unless another process has put one there."""
    try:
        made.rename(folder)
    except OSError:
        if not folder.is_dir():
            raise
