"""A finished result solved again from what was measured, in seconds: nothing is tracked anew."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorsfm.control.known import Control
from factorsfm.lens.camera_model import distortion_of
from factorsfm.lens.lens import Lens
from factorsfm.mending.changes import Changes, MaskRegion
from factorsfm.mending.joined import joined
from factorsfm.mending.same_world import in_world_of
from factorsfm.mending.taken_up import taken_up
from factorsfm.mending.user_tracks import UserTracks, read_tracks
from factorsfm.polish.measured import MeasuredShot
from factorsfm.polish.polished import Polished
from factorsfm.report.thumbnails import take_from_report
from factorsfm.result.frame_results import mapped_results
from factorsfm.result.left_out import add_left_out
from factorsfm.result.reading import read_result
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.repeats import add_recorded, add_results
from factorsfm.result.solved_shot import solved_shot
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.progress import Progress
from factorsfm.support.threads import OneThreadEach


def solve_again(
    result: str | Path | Reconstruction,
    *,
    without_tracks: Iterable[int | str] = (),
    mask_regions: Sequence[MaskRegion | str] = (),
    frames: slice | None = None,
    control: str | Path | Control | None = None,
    tracks: str | Path | UserTracks | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """The final solve of a shot once more, from what was measured for a result, with changes.

    Lens, prior and options are treated as they were. The new result is in the world and the unit of the other one,
    unless control says where it is. It keeps what was measured without what is left out here.

    Args:
        result: that of a video; its folder, or a `Reconstruction`.
        without_tracks: tracks that are left out: numbers as in COLMAP's model and in names of tracks, or names, which
            come before numbers in texts.
        mask_regions: in which nothing counts, or their texts, see `MaskRegion.parse`.
        frames: the others are left out; numbers as in the result.
        control: what is known beforehand, or its JSON file; None is that of the result, if it had some.
        tracks: of the user, that take part from now on, or their file (`read_tracks`).
        progress: called with the stage.

    Raises:
        InputError: the result keeps no tracks, or a change cannot be made.
        ReconstructionError: the shot cannot be solved with these changes.
    """
    begin = time.perf_counter()
    known = result if isinstance(result, Reconstruction) else read_with_pictures(result)
    if known.measured is None:
        raise InputError(
            "the result keeps no tracks to solve again: it is of images in any order, has images that were added, or "
            "is of an earlier version; reconstruct the shot once more"
        )
    first_number = known.options.get("first_number")
    changes = Changes.of(without_tracks, mask_regions, frames, control, first_number)
    measured = changes.applied(known.measured)
    if isinstance(tracks, str | Path):
        tracks = read_tracks(tracks, first_number=first_number)
    if tracks is not None:
        measured = taken_up(joined(measured, tracks, {frame.index: known.camera_of(frame) for frame in known.frames}))
    measured = replace(measured, solved_lens=_solved_lens(known))
    with OneThreadEach():
        polished = _polished(measured, known, progress)
        solved = solved_shot(measured, polished, {"polish": time.perf_counter() - begin})
    add_recorded(solved, measured.footage)
    solved = in_world_of(known, solved)
    _take_over_frames(solved, known, changes)
    solved.notes += [*_not_again(known), *changes.notes(known.measured)]
    said = {**changes.said(), "tracks": None if tracks is None else tracks.source}
    solved.options = {**known.options, "solved_again": [*known.options.get("solved_again", []), said]}
    solved.seconds["total"] = time.perf_counter() - begin
    return solved


def _solved_lens(known: Reconstruction) -> Lens | None:
    """The unknown lens that a result has found, None where it has found none, or one that zooms."""
    if known.lens is None or known.lens.focal_std is None or known.has_own_lenses:
        return None
    return Lens(np.array([known.camera.mean_focal_length()]), np.r_[distortion_of(known.camera), np.zeros(2)])


def _polished(measured: MeasuredShot, known: Reconstruction, progress: Progress | None) -> Polished:
    """The final solve; an error knows what has become of the frames."""

    def solved(measured: MeasuredShot) -> Polished:
        return measured.solved(lambda stage: progress(stage, 0, None) if progress else None)

    try:
        polished = solved(measured)
        lens = polished.lens
        if measured.solved_lens is None or lens is None or lens.determined or lens.rough:
            return polished
        return solved(replace(measured, solved_lens=None))  # a search may find a lens where its earlier value does not
    except ReconstructionError as error:
        frames = add_results(mapped_results(measured.frames, measured.images), measured.footage)
        _take_over_pictures(frames, known)
        raise ReconstructionError(str(error), frames) from error


def read_with_pictures(directory: str | Path) -> Reconstruction:
    """A result, read back, with the pictures of its report; errors as in `read_result`."""
    result = read_result(directory)
    take_from_report(result, Path(directory) / "report.html")
    return result


def _take_over_frames(solved: Reconstruction, known: Reconstruction, changes: Changes) -> None:
    """The pictures of the frames; and the frames that were not measured as they are, such as slates beside the shot."""
    _take_over_pictures(solved.frames, known)
    there = {frame.index for frame in solved.frames}
    add_left_out(solved, [f for f in known.frames if f.index not in there and changes.keeps(f.index)])


def _take_over_pictures(frames: Iterable[FrameResult], known: Reconstruction) -> None:
    by_index = {frame.index: frame for frame in known.frames}
    for frame in frames:
        frame.thumbnail = by_index[frame.index].thumbnail


def _not_again(known: Reconstruction) -> list[str]:
    """What of the known result takes no part again, in sentences."""
    notes = []
    if known.objects:
        notes.append("Objects are not solved again; that takes the shot and its masks once more.")
    if known.imu is not None or (known.control is not None and known.control.source == "factors"):
        notes.append("What an IMU or added factors say takes no part again; world and unit stay as they were.")
    return notes
