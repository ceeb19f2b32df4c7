"""What became of each photograph of a set: in the maps, in the result, and in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from factorsfm.imagesets.mapper import SetMapper
from factorsfm.imagesets.photo_folder import Photo
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.first_few import first_few
from factorsfm.support.status import FrameStatus

_NAMED = 5  # photographs in a note, at most


def explain_missing(parts: Sequence[SetMapper], photos: Sequence[Photo]) -> None:
    """Say of every image that is not in a part why, and where it is instead."""
    home = {i.tracks.position: p for p, part in enumerate(parts) for i in part.images if i.registered}
    for p, part in enumerate(parts):
        for k, (photo, image) in enumerate(zip(photos, part.images, strict=True)):
            if photo.left_out:
                part.explain(k, FrameStatus.UNUSABLE, photo.left_out)
            elif k in home and home[k] != p:
                reason = "" if image.status is FrameStatus.REGISTERED else f"{image.message}; "
                place = f"it is in part {home[k] + 1}, of {parts[home[k]].registered} images"
                part.explain(k, FrameStatus.LOST, reason + place)
            elif photo.remark:
                blank = "keypoints" in photo.remark
                status = FrameStatus.BLANK if blank else image.status
                part.explain(k, status, photo.remark if blank else f"{image.message}; {photo.remark}")


def add_twins(result: Reconstruction, photos: Sequence[Photo]) -> None:
    """An image with the pixels of another one has its pose."""
    for photo, frame in zip(photos, result.frames, strict=True):
        if photo.twin is not None and not photo.left_out:
            twin = result.frames[photo.twin]
            frame.status, frame.cam_from_world = twin.status, twin.cam_from_world
            frame.covariance, frame.observability = twin.covariance, twin.observability
            fate = "whose pose it has" if twin.registered else twin.message
            frame.message = f"the same image as {twin.name}, {fate}"
        elif photo.remark and frame.registered:
            frame.message += f"; {photo.remark}"


def photo_notes(result: Reconstruction, photos: Sequence[Photo], number: int, parts: Sequence[SetMapper]) -> list[str]:
    """What a user should read of the photographs in the result of a part.

    Args:
        number: of the part, from 1 on.
    """
    notes = by_reason((photo.name, photo.left_out) for photo in photos)
    notes += by_reason((photo.name, photo.remark) for photo in photos)
    if len(parts) > 1:
        sizes = ", ".join(str(part.registered) for part in parts)
        notes.append(
            f"The images fall into {len(parts)} parts that could not be joined, of {sizes} images; this is "
            f"part {number}, and each has a scale and a world of its own."
        )
    found = {i.tracks.position for part in parts for i in part.images if i.registered}
    missing = [
        frame
        for k, (frame, photo) in enumerate(zip(result.frames, photos, strict=True))
        if not photo.left_out and k not in found and photo.twin not in found
    ]
    if missing:
        some = "; ".join(f"{frame.name}: {frame.message}" for frame in missing[:3])
        notes.append(f"{len(missing)} of {len(result.frames)} images could not be registered ({some}).")
    twins = [photo for photo in photos if photo.twin is not None and not photo.left_out]
    if twins:
        some = _some([f"{photo.name} (as {photos[photo.twin or 0].name})" for photo in twins])
        notes.append(f"Images that repeat another one have its pose: {some}.")
    return notes


def by_reason(said: Iterable[tuple[str, str]]) -> list[str]:
    """One note for each reason, of names and reasons; an empty reason is none."""
    names: dict[str, list[str]] = {}
    for name, reason in said:
        if reason:
            names.setdefault(reason, []).append(name)
    return [f"{_some(those)}: {reason}." for reason, those in names.items()]


def _some(names: list[str]) -> str:
    return first_few(names, _NAMED) + (f" ({len(names)} in all)" if len(names) > _NAMED else "")
