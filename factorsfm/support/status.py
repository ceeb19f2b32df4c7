"""The status of a frame, and the kind of motion of a shot."""

from __future__ import annotations

from enum import StrEnum


class FrameStatus(StrEnum):
    """What became of a frame; `FrameResult.message` says why, with numbers."""

    REGISTERED = "registered"
    STATIC = "static"  # registered; the camera has not moved measurably since the first frame
    INERTIAL = "inertial"  # the image shows nothing; the pose is the IMU's
    TOO_FEW_TRACKS = "too_few_tracks"
    TOO_FEW_INLIERS = "too_few_inliers"
    LOST = "lost"  # the image shows nothing that is in the map
    BLANK = "blank"  # black, white or blurred: no texture to track
    WAITING = "waiting"  # the map is not yet initialised
    LEFT_OUT = "left_out"  # not of the shot: a slate, bars, a piece of another shot
    UNUSABLE = "unusable"  # an image of a set that cannot be read


class ShotKind(StrEnum):
    """The motion of the camera, which decides what geometry can recover."""

    GENERAL = "general"  # rotation and translation
    ROTATION = "rotation"  # rotation only: translation is not observable
    STATIC = "static"  # none
