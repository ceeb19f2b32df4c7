"""What became of the tracks that the user vouches for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorsfm.control.fit import CONTRADICTION
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.tracks.image_tracks import seen_by

_MOST_NAMED = 12  # tracks in a sentence
_MOST_OFF = 1 / 3  # of the supervised tracks, with which a solve that rests on them may still be right


@dataclass(frozen=True, slots=True)
class NamedPoint:
    """The point of a supervised track.

    Attributes:
        name: of the user; track: number of the track, that of its point in COLMAP's model.
        position: (3,) in the world of the result; None if it cannot be placed.
        frames: how many registered frames see it.
        error, sigma: root of its mean squared error in each coordinate, and the standard deviation that the user gave,
            pixels; NaN if it cannot be placed.
        contradicts: whether the error is so large that the track has hardly any weight.
    """

    name: str
    track: int
    position: list[float] | None
    frames: int
    error: float
    sigma: float
    contradicts: bool


def named_points(result: Reconstruction) -> list[NamedPoint]:
    """The points of the supervised tracks of a result, those too that cannot be placed."""
    if result.measured is None:
        return []
    known, found = result.measured.supervised, []
    row_of = {track: row for row, track in enumerate(result.track_ids.tolist())}
    registered = np.array([frame.registered for frame in result.frames], bool)
    for track, name, sigma in zip(known.ids.tolist(), known.names, known.sigma.tolist(), strict=True):
        seen = (result.observation_point == row_of.get(track, -1)) & registered[result.observation_frame]
        placed = track in row_of and bool(seen.any())
        error = float(np.sqrt(0.5 * np.mean(result.observation_error[seen] ** 2))) if placed else np.nan
        position = result.points[row_of[track]].tolist() if placed else None
        contradicts = error > CONTRADICTION * sigma
        found.append(NamedPoint(name, track + 1, position, int(seen.sum()), error, sigma, contradicts))
    return found


def supervised_notes(result: Reconstruction) -> list[str]:
    """Which supervised tracks do not fit, and which have no point, in sentences."""
    points, notes = named_points(result), []
    off = sorted((point for point in points if point.contradicts), key=lambda point: -point.error)
    if off:
        named = [f"{point.name} ({point.error:.1f} px)" for point in off]
        notes.append(
            f"Supervised tracks that contradict the others and hardly count: {len(off)} of {len(points)}; "
            f"{_some(named)}."
        )
    if lost := [point.name for point in points if point.position is None]:
        notes.append(f"Supervised tracks without a point, since the solved frames do not place it: {_some(lost)}.")
    return notes


def supervised_doubts(result: Reconstruction) -> list[str]:
    """Why a result that rests on its supervised tracks is doubtful, in sentences."""
    if result.measured is None or not result.measured.supervised.join:
        return []
    points, often = named_points(result), seen_by([i.tracks for i in result.measured.images if i.registered], 2)
    off = [point.name for point in points if point.contradicts]
    behind = [point.name for point in points if point.position is None and point.track - 1 in often]
    doubts = []
    if len(off) > _MOST_OFF * len(points):
        doubts.append(f"Of the {len(points)} supervised tracks that join frames, {len(off)} contradict the others.")
    if behind:
        doubts.append(f"Supervised tracks that join frames have no point in front of the cameras: {_some(behind)}.")
    return doubts


def _some(names: list[str]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
