"""Changes to a measured shot: tracks, regions of the image and frames that are left out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.control.files import read_control
from factorsfm.control.known import Control
from factorsfm.control.tracked_points import without_tracked
from factorsfm.frames.ranges import checked_range, in_range, parse_range, range_text
from factorsfm.polish.measured import MeasuredShot
from factorsfm.support.errors import InputError
from factorsfm.support.first_few import first_few
from factorsfm.tracks.supervised import track_name

Index = NDArray[np.int64]

_MOST_NAMED = 10  # tracks in a note


@dataclass(frozen=True, slots=True)
class MaskRegion:
    """A rectangle of the image in which nothing counts.

    Attributes:
        x, y, width, height: of its top left corner and size, pixels with centres at integers.
        frames: numbers of the frames, None for all.

    Raises:
        InputError: it is empty.
    """

    x: float
    y: float
    width: float
    height: float
    frames: slice | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite([self.x, self.y]).all() and 0 < self.width < np.inf and 0 < self.height < np.inf):
            raise InputError(f'the region "{self}" is empty; a width and a height above 0 are expected')

    @classmethod
    def parse(cls, text: str) -> MaskRegion:
        """From ``[START:STOP[:STEP]:]X,Y,WIDTH,HEIGHT``.

        Raises:
            InputError: it has another form.
        """
        frames, _, rectangle = text.rpartition(":")
        try:
            x, y, width, height = map(float, rectangle.split(","))
        except ValueError:
            raise InputError(f'"{text}" is no region; [START:STOP:]X,Y,WIDTH,HEIGHT is expected') from None
        return cls(x, y, width, height, parse_range(frames) if frames else None)

    def __str__(self) -> str:
        rectangle = ",".join(f"{value:g}" for value in (self.x, self.y, self.width, self.height))
        return rectangle if self.frames is None else f"{range_text(self.frames)}:{rectangle}"

    def covers(self, frame: int, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) which pixels (n, 2) of a frame are in it."""
        if self.frames is not None and not in_range(frame, self.frames):
            return np.zeros(len(xy), bool)
        low = np.array([self.x, self.y])
        return np.asarray(((xy >= low) & (xy < low + [self.width, self.height])).all(axis=1))


@dataclass(frozen=True, slots=True)
class Changes:
    """What is changed before a shot is solved again.

    Attributes:
        tracks: that are left out, by their numbers or names (a text that is both is a name); regions: in which nothing
            counts.
        frames: to which it is cut, None for all.
        control: what is known beforehand, None where that stays as it was; control_from: its file.
    """

    tracks: tuple[int | str, ...]
    regions: tuple[MaskRegion, ...]
    frames: slice | None
    control: Control | None
    control_from: str | None

    @classmethod
    def of(
        cls,
        without_tracks: Iterable[int | str],
        mask_regions: Iterable[MaskRegion | str],
        frames: slice | None,
        control: str | Path | Control | None,
        first_number: int | None,
    ) -> Changes:
        """As `solve_again` takes them.

        Args:
            first_number: as in `read_control`.

        Raises:
            InputError: a track, a region, the range or the control cannot be used.
        """
        tracks = _listed("without_tracks", without_tracks, int | str | np.integer, "numbers and names of tracks")
        regions = _listed("mask_regions", mask_regions, MaskRegion | str, "regions")
        read = read_control(control, first_number) if isinstance(control, str | Path) else control
        return cls(
            tracks,
            tuple(r if isinstance(r, MaskRegion) else MaskRegion.parse(r) for r in regions),
            None if frames is None else checked_range(frames),
            read,
            str(control) if isinstance(control, str | Path) else None,
        )

    def applied(self, measured: MeasuredShot) -> MeasuredShot:
        """The shot with these changes.

        Raises:
            InputError: a track, a frame or what a region covers is not there.
        """
        if self.tracks:
            measured = _without_tracks(measured, self.tracks)
        if self.regions:
            measured = _without_regions(measured, self.regions)
        if self.frames is not None:
            measured = _in_frames(measured, self.frames)
        return measured if self.control is None else replace(measured, control=self.control)

    def keeps(self, frame: int) -> bool:
        """Whether the frame with this number stays."""
        return self.frames is None or in_range(frame, self.frames)

    def said(self) -> dict[str, Any]:
        """As the options of a result hold them."""
        return {
            "without_tracks": [str(track) for track in self.tracks],
            "mask_regions": [str(region) for region in self.regions],
            "frames": None if self.frames is None else range_text(self.frames),
            "control": self.control_from or ("given" if self.control is not None else None),
        }

    def notes(self, measured: MeasuredShot) -> list[str]:
        """What of a shot was left out, in sentences."""
        notes = []
        if self.tracks:
            names = measured.supervised.names_of(_ids_of(measured, self.tracks))
            named = first_few(names, _MOST_NAMED)
            count = f"{len(names)} track{'s' * (len(names) != 1)}"
            notes.append(f"Solved again without {count}: {named}.")
        if self.regions:
            notes.append(f"Solved again without what is seen in {' and '.join(map(str, self.regions))}.")
        return notes


def _listed(name: str, given: Any, kinds: Any, expected: str) -> tuple[Any, ...]:
    """What is in an argument that is a list; a text is no list of its letters."""
    listed = isinstance(given, Iterable) and not isinstance(given, str)
    items = tuple(given) if listed else ()
    if not listed or not all(isinstance(item, kinds) and not isinstance(item, bool) for item in items):
        raise InputError(f"{name} is {given!r:.80}; a list of {expected} is expected")
    return items


def _without_tracks(measured: MeasuredShot, names: Sequence[int | str]) -> MeasuredShot:
    """Without some tracks, by their numbers or names.

    Raises:
        InputError: a track is not there, or without it the control does not determine where the scene is.
    """
    ids = _ids_of(measured, names)
    images = [replace(image, tracks=image.tracks.of(~np.isin(image.tracks.ids, ids))) for image in measured.images]
    points, places = measured.map_points
    mapped, control = ~np.isin(points, ids), measured.control
    if control is not None:
        control = without_tracked(control, measured.supervised.of(ids).names)
    return replace(
        measured,
        control=control,
        images=images,
        map_points=(points[mapped], places[mapped]),
        suspects=np.setdiff1d(measured.suspects, ids),
        supervised=measured.supervised.without(ids),
    )


def _ids_of(measured: MeasuredShot, names: Sequence[int | str]) -> Index:
    """(n,) ids, ascending, of tracks by their numbers or names.

    A text that is both, as "5" where the user has called a track so, is the name.
    """
    there = np.unique(np.concatenate([image.tracks.ids for image in measured.images]))
    by_name: dict[int | str, int] = {}
    for track in there.tolist():
        by_name |= {track_name(track): track, str(track + 1): track, track + 1: track}
    by_name |= zip(measured.supervised.names, measured.supervised.ids.tolist(), strict=True)
    if missing := [name for name in names if name not in by_name]:
        raise InputError(f"there is no track {missing[0]} among the {len(there):,} tracks of the result")
    return np.unique(np.array([by_name[name] for name in names], np.int64))


def _without_regions(measured: MeasuredShot, regions: Sequence[MaskRegion]) -> MeasuredShot:
    """Without what is seen in some regions.

    Raises:
        InputError: nothing is seen in a region.
    """
    images, empty = [], {str(region) for region in regions}
    for image in measured.images:
        covered = np.zeros(len(image.tracks.ids), bool)
        for region in regions:
            mine = region.covers(image.tracks.frame, image.tracks.pixels)
            covered |= mine
            if mine.any():
                empty.discard(str(region))
        images.append(replace(image, tracks=image.tracks.of(~covered)) if covered.any() else image)
    if empty:
        raise InputError(f"no track is in the region {min(empty)}")
    return replace(measured, images=images)


def _in_frames(measured: MeasuredShot, frames: slice) -> MeasuredShot:
    """Some of the frames alone.

    Raises:
        InputError: the range has none of them.
    """
    kept = [k for k, frame in enumerate(measured.frames) if in_range(frame.index, frames)]
    if not kept:
        first, last = measured.frames[0].index, measured.frames[-1].index
        raise InputError(f"no frame of the result is in {range_text(frames)}; it has {first} to {last}")
    images = [measured.images[position] for position in kept]
    return replace(
        measured,
        frames=[measured.frames[position] for position in kept],
        footage=measured.footage.of(kept),
        images=[replace(image, tracks=replace(image.tracks, position=k)) for k, image in enumerate(images)],
    )
