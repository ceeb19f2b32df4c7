"""Frames of the source that do not belong to the shot, in its result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorsfm.result.reconstruction import FrameResult, Reconstruction


def add_left_out(result: Reconstruction, left_out: Sequence[FrameResult]) -> None:
    """Put the frames where their numbers belong; positions of observations follow."""
    frames = sorted([*result.frames, *left_out], key=lambda frame: frame.index)
    place = {id(frame): position for position, frame in enumerate(frames)}
    positions = np.array([place[id(frame)] for frame in result.frames], np.int64)
    result.observation_frame = positions[result.observation_frame]
    result.frames = frames
