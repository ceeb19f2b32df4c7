"""Depth-guided structure from motion for shots with little parallax, on a GTSAM factor graph."""

# pycolmap's library exports symbols of zlib; unless Python's zlib is loaded first, compression aborts the process.
import zlib  # noqa: F401  isort: skip
import logging

from factorsfm.api import reconstruct
from factorsfm.camera import guess_camera, read_camera
from factorsfm.control import Control, KnownDistance, KnownHeight, KnownPose, MarkedPoint, read_control
from factorsfm.episode import Episode, ShotResult
from factorsfm.errors import FactorsfmError, InputError, ModelError, ReconstructionError
from factorsfm.explicit_graph import factor_graph
from factorsfm.export.options import ExportOptions, UpAxis
from factorsfm.export.reading import read_result
from factorsfm.extension import add_images
from factorsfm.frame_update import FrameUpdate
from factorsfm.frames import Frame, read_frames
from factorsfm.live import Live, track
from factorsfm.options import PRESETS, MapperOptions, Options, PolishOptions, TrackerOptions
from factorsfm.priors.depth import DepthFolder, DepthKind, DepthMap, DepthModel, DepthPrior
from factorsfm.priors.masks import MaskFolder, MaskModel, MaskPrior
from factorsfm.reconstruction import (
    CameraObservability,
    ControlFit,
    ControlResidual,
    FrameResult,
    FrameStatus,
    PriorFit,
    Reconstruction,
    ShotKind,
)
from factorsfm.shots import CutDetector, ShotUpdate, find_shots
from factorsfm.sources import RawFormat, Source, open_source
from factorsfm.stream import Stream

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "PRESETS",
    "CameraObservability",
    "Control",
    "ControlFit",
    "ControlResidual",
    "CutDetector",
    "DepthFolder",
    "DepthKind",
    "DepthMap",
    "DepthModel",
    "DepthPrior",
    "Episode",
    "ExportOptions",
    "FactorsfmError",
    "Frame",
    "FrameResult",
    "FrameStatus",
    "FrameUpdate",
    "InputError",
    "KnownDistance",
    "KnownHeight",
    "KnownPose",
    "Live",
    "MapperOptions",
    "MarkedPoint",
    "MaskFolder",
    "MaskModel",
    "MaskPrior",
    "ModelError",
    "Options",
    "PolishOptions",
    "PriorFit",
    "RawFormat",
    "Reconstruction",
    "ReconstructionError",
    "ShotKind",
    "ShotResult",
    "ShotUpdate",
    "Source",
    "Stream",
    "TrackerOptions",
    "UpAxis",
    "add_images",
    "factor_graph",
    "find_shots",
    "guess_camera",
    "open_source",
    "read_camera",
    "read_control",
    "read_frames",
    "read_result",
    "reconstruct",
    "track",
]
