"""What becomes of a frame, and what the motion of a shot allows one to recover."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


class FrameStatus(StrEnum):
    """What became of a frame; the sentence with the numbers is `FrameResult.message`."""

    REGISTERED = "registered"
    STATIC = "static"  # registered; the camera does not move measurably against the first frame
    TOO_FEW_TRACKS = "too_few_tracks"
    TOO_FEW_INLIERS = "too_few_inliers"
    LOST = "lost"  # what the image shows is not in the map
    BLANK = "blank"  # black, white or blurred: no texture to track
    WAITING = "waiting"  # not yet initialised
    UNUSABLE = "unusable"  # of an image set: unreadable


class ShotKind(StrEnum):
    """What the motion of the shot allows one to recover."""

    GENERAL = "general"  # rotation and translation from geometry
    ROTATION = "rotation"  # pure rotation: translation is not observable from geometry
    STATIC = "static"  # the camera does not move
