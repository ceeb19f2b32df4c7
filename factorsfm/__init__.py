"""Depth-guided structure from motion for shots with little parallax, on a GTSAM factor graph."""

# pycolmap's library exports symbols of zlib; unless Python's zlib is loaded first, compression aborts the process.
import zlib  # noqa: F401  isort: skip
import logging

from factorsfm.api import reconstruct
from factorsfm.camera import guess_camera, read_camera
from factorsfm.errors import FactorsfmError, InputError, ModelError, ReconstructionError
from factorsfm.frames import Frame, read_frames
from factorsfm.options import PRESETS, MapperOptions, Options, PolishOptions, TrackerOptions
from factorsfm.priors.depth import DepthFolder, DepthKind, DepthMap, DepthModel, DepthPrior
from factorsfm.priors.masks import MaskFolder, MaskModel, MaskPrior
from factorsfm.reconstruction import FrameResult, FrameStatus, PriorFit, Reconstruction, ShotKind
from factorsfm.stream import FrameUpdate, Stream

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "PRESETS",
    "DepthFolder",
    "DepthKind",
    "DepthMap",
    "DepthModel",
    "DepthPrior",
    "FactorsfmError",
    "Frame",
    "FrameResult",
    "FrameStatus",
    "FrameUpdate",
    "InputError",
    "MapperOptions",
    "MaskFolder",
    "MaskModel",
    "MaskPrior",
    "ModelError",
    "Options",
    "PolishOptions",
    "PriorFit",
    "Reconstruction",
    "ReconstructionError",
    "ShotKind",
    "Stream",
    "TrackerOptions",
    "guess_camera",
    "read_camera",
    "read_frames",
    "reconstruct",
]
