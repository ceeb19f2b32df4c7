"""Depth-guided structure from motion for shots with little parallax, on a GTSAM factor graph."""

# pycolmap's library exports symbols of zlib; unless Python's zlib is loaded first, compression aborts the process.
import zlib  # noqa: F401  isort: skip
import logging

from factorsfm.alignment.align import Length, align
from factorsfm.alignment.picks import Pick
from factorsfm.api import reconstruct
from factorsfm.camera.files import read_camera
from factorsfm.camera.guess import guess_camera
from factorsfm.control.files import read_control
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.control.known import Control, KnownDistance, KnownHeight, KnownPose, MarkedPoint
from factorsfm.export.options import ExportOptions
from factorsfm.frames.cuts import CutDetector, ShotUpdate
from factorsfm.frames.edits import find_shots
from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import Source, open_source
from factorsfm.frames.raw import RawFormat
from factorsfm.frames.reading import read_frames
from factorsfm.graph.condensed import condensed_factor
from factorsfm.graph.explicit_graph import factor_graph
from factorsfm.graph.pose_factors import pose_factors
from factorsfm.imagesets.add_images import add_images
from factorsfm.inertial.fit import ImuFit
from factorsfm.inertial.mounting import open_imu
from factorsfm.inertial.recording import ImuNoise, ImuRecording
from factorsfm.mending.changes import MaskRegion
from factorsfm.mending.solve_again import solve_again
from factorsfm.mending.user_tracks import UserTrack, UserTracks, read_tracks
from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.polish.observability import CameraObservability
from factorsfm.priors.depth import DepthFolder, DepthModel, DepthPrior
from factorsfm.priors.depth_map import DepthKind, DepthMap
from factorsfm.priors.masks import MaskFolder, MaskModel, MaskPrior
from factorsfm.priors.object_masks import ObjectFolder, ObjectMasks
from factorsfm.result.alignment import Alignment
from factorsfm.result.moving import Moving, MovingStretch
from factorsfm.result.reading import read_result
from factorsfm.result.reconstruction import FrameResult, PriorFit, Reconstruction
from factorsfm.streaming.episode import Episode, ShotResult
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.live import Live, track
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import FactorsfmError, InputError, ModelError, ReconstructionError
from factorsfm.support.options import PRESETS, MapperOptions, Options, PolishOptions, TrackerOptions
from factorsfm.support.status import FrameStatus, ShotKind
from factorsfm.support.up_axis import UpAxis

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "PRESETS",
    "Alignment",
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
    "ImuFit",
    "ImuNoise",
    "ImuRecording",
    "InputError",
    "KnownDistance",
    "KnownHeight",
    "KnownPose",
    "Length",
    "Live",
    "MapperOptions",
    "MarkedPoint",
    "MaskFolder",
    "MaskModel",
    "MaskPrior",
    "MaskRegion",
    "ModelError",
    "Moving",
    "MovingStretch",
    "ObjectFolder",
    "ObjectFrame",
    "ObjectMasks",
    "ObjectResult",
    "Options",
    "Pick",
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
    "UserTrack",
    "UserTracks",
    "add_images",
    "align",
    "condensed_factor",
    "factor_graph",
    "find_shots",
    "guess_camera",
    "open_imu",
    "open_source",
    "pose_factors",
    "read_camera",
    "read_control",
    "read_frames",
    "read_result",
    "read_tracks",
    "reconstruct",
    "solve_again",
    "track",
]
