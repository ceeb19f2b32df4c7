"""Frames that repeat the one before, in a result.

A repeated frame is no evidence: it has the pose of the frame that it repeats, its twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorsfm.frames.recorded import RecordedFootage, Repeat
from factorsfm.result.reconstruction import FrameResult, Reconstruction


def add_recorded(result: Reconstruction, footage: RecordedFootage) -> None:
    """Give the repeated frames their results, and say what there is to say of the recording."""
    notes = footage.notes(result.frames, result.camera)
    position = np.array(footage.positions(len(result.frames)), np.int64)
    result.frames = add_results(result.frames, footage)
    result.observation_frame = position[result.observation_frame]
    result.notes += notes


def add_results(frames: Sequence[FrameResult], footage: RecordedFootage) -> list[FrameResult]:
    """The results of all frames, from those of the frames that repeat none."""
    found = list(frames)
    for repeat in reversed(footage.repeats):
        twin = frames[repeat.twin]
        found.insert(repeat.twin + 1, _like_twin(twin, repeat))
    return found


def _like_twin(twin: FrameResult, repeat: Repeat) -> FrameResult:
    """The result of a repeated frame: that of its twin, without what a frame adds to it."""
    return replace(
        twin,
        index=repeat.index,
        name=repeat.name,
        timestamp=repeat.timestamp,
        message=f"repeats frame {twin.index}: {twin.message}",
        repeats=twin.index,
        keyframe=False,
        relative_covariance=None,
    )
