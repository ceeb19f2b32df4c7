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
    lost = np.array([not frame.registered for frame in frames], bool)
    for a, b in _stretches(lost):  # what is on both sides of an interruption is the same
        if a > 0 and b < len(frames) and _share(images[a - 1], images[b]) >= _LARGE_STEP:
            lost[a:b] = False
    shares = []
    for k, pair in enumerate(itertools.pairwise(frames)):
        if lost[k : k + 2].any() and not any(frame.status in _UNTRACKED for frame in pair):
            shares.append(_share(images[k], images[k + 1]))
    if not shares or (typical := float(np.median(shares))) >= _LARGE_STEP:
        return sentence
    return (
        f"{sentence.removesuffix('.')}. The steps between frames are too large: only {100 * typical:.0f} % of the "
        "points of a frame can be followed into the next one. Take more frames a second, or try --unordered."
    )


def _share(before: MappedImage, after: MappedImage) -> float:
    """Of the tracks of an image, those that another one has, too."""
    ids = before.tracks.ids
    return float(np.isin(ids, after.tracks.ids).mean()) if len(ids) else 0.0


def _stretches(lost: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and one after the last position of each stretch."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _without_pose(frames: Sequence[FrameResult], lost: NDArray[np.bool_]) -> str:
    stretches = [(frames[a].index, frames[b - 1].index) for a, b in _stretches(lost)]
    said = [str(first) if first == last else f"{first} to {last}" for first, last in stretches[:_MOST_NAMED]]
    more = len(stretches) - len(said)
    return (
        f"Without a pose: {'frame' if lost.sum() == 1 else 'frames'} {', '.join(said)}"
        f"{f' and {more} more stretches' if more else ''} ({int(lost.sum())} of {len(frames)})."
    )
