"""The result of a shot, from what was measured and its final solve."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorsfm.polish.measured import MeasuredShot
from factorsfm.polish.polished import Polished
from factorsfm.result.assembly import assemble
from factorsfm.result.lost_frames import lost_frames
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.supervised import supervised_doubts, supervised_notes


def solved_shot(measured: MeasuredShot, polished: Polished, seconds: Mapping[str, float]) -> Reconstruction:
    """The result, without the frames that repeat others (`add_recorded`); `seconds`: of the stages so far."""
    result = assemble(
        polished,
        measured.images,
        measured.frames,
        measured.colors,
        measured.camera,
        lens_given=measured.lens_given,
        depth_kind=measured.depth_kind,
        seconds=dict(seconds),
        interval=measured.footage.interval(measured.frames),
        options=measured.options.to_dict(),
    )
    result.measured = measured
    if lost := lost_frames(result.frames, measured.images):
        result.notes.append(lost)
    if len(measured.suspects):
        agree = int(np.isin(polished.tracks, measured.suspects).sum())
        result.notes.append(
            f"Tracks that a network takes for what moves: {len(measured.suspects)}; {agree} of them agree with the "
            "scene and take part."
        )
    result.doubts += supervised_doubts(result)
    result.notes += [*supervised_notes(result), *measured.notes]
    return result
