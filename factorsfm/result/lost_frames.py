"""Which frames of a shot have no pose, and whether the steps between frames are too large to follow points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.result.reconstruction import FrameResult
from factorsfm.support.status import FrameStatus

_MOST_NAMED = 3  # stretches of frames

# Share of the tracks of a frame that go on in the next one. Where one frame of six or ten was kept of walks and arcs
# and all could be solved it is 0.29 and more between any two; where frames get lost it is 0.1 and less.
_LARGE_STEP = 0.15
_UNTRACKED = (FrameStatus.BLANK, FrameStatus.TOO_FEW_TRACKS)


def lost_frames(frames: Sequence[FrameResult], images: Sequence[MappedImage]) -> str:
    """What there is to say of the frames that have no pose, in sentences; empty if all have one.

    Args:
        frames: what became of them, in order; images: their tracks.
    """
    lost = np.array([not frame.registered for frame in frames], bool)
    return with_large_steps(_without_pose(frames, lost), frames, images) if lost.any() else ""


def with_large_steps(sentence: str, frames: Sequence[FrameResult], images: Sequence[MappedImage]) -> str:
    """The sentence, and after it that frames get lost because each shows something else, where that is so."""
    shares = []
    for pair, (before, after) in zip(itertools.pairwise(frames), itertools.pairwise(images), strict=True):
        if all(frame.registered for frame in pair) or any(frame.status in _UNTRACKED for frame in pair):
            continue
        ids = before.tracks.ids
        shares.append(float(np.isin(ids, after.tracks.ids).mean()) if len(ids) else 0.0)
    if not shares or (typical := float(np.median(shares))) >= _LARGE_STEP:
        return sentence
    return (
        f"{sentence.removesuffix('.')}. The steps between frames are too large: only {100 * typical:.0f} % of the "
        "points of a frame can be followed into the next one. Take more frames a second, or try --unordered."
    )


def _without_pose(frames: Sequence[FrameResult], lost: NDArray[np.bool_]) -> str:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
    stretches = [(frames[a].index, frames[b - 1].index) for a, b in edges.reshape(-1, 2).tolist()]
    said = [str(first) if first == last else f"{first} to {last}" for first, last in stretches[:_MOST_NAMED]]
    more = len(stretches) - len(said)
    return (
        f"Without a pose: {'frame' if lost.sum() == 1 else 'frames'} {', '.join(said)}"
        f"{f' and {more} more stretches' if more else ''} ({int(lost.sum())} of {len(frames)})."
    )
