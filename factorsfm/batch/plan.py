"""The plan of a batch: the videos, their shots, and one job per shot."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from factorsfm.batch.outcome import is_result_of
from factorsfm.camera.files import camera_to_json
from factorsfm.frames.edits import find_shots
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_files
from factorsfm.frames.video import VIDEO_SUFFIXES
from factorsfm.priors.masks import MaskFolder
from factorsfm.priors.object_masks import FROM_MOTION, ObjectFolder
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import json_text
from factorsfm.support.options import LensFreedom, ShutterUse


@dataclass(frozen=True, slots=True)
class Method:
    """The arguments of `factorsfm.reconstruct` for all shots, with absolute paths.

    Attributes:
        align: whether each result is aligned, too, see `factorsfm.align`.
    """

    camera: pycolmap.Camera | None = None
    depth: str | None = None
    depth_kind: str | None = None
    masks: str | None = None
    objects: str | None = None
    preset: str = "default"
    lens: LensFreedom = "auto"
    shutter: ShutterUse = "auto"
    pixel_aspect: float | None = None
    align: bool = False

    def of_video(self, name: str) -> Method:
        """For one of several videos: with the folders of its maps and masks."""
        depth, masks, objects = self.depth, self.masks, self.objects
        if depth is not None and Path(depth).is_dir():
            depth = str(Path(depth) / name)
        if masks is not None and Path(masks).is_dir():
            masks = str(Path(masks) / name) if (Path(masks) / name).is_dir() else None
        if objects is not None and objects != FROM_MOTION:
            objects = str(Path(objects) / name) if (Path(objects) / name).is_dir() else None
        return replace(self, depth=depth, masks=masks, objects=objects)

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "camera": self.camera and camera_to_json(self.camera),
            "depth": self.depth,
            "depth_kind": self.depth_kind,
            "masks": self.masks,
            "objects": self.objects,
            "preset": self.preset,
            "lens": self.lens,
            "shutter": self.shutter,
            "pixel_aspect": self.pixel_aspect,
            "align": self.align,
        }


@dataclass(frozen=True, slots=True)
class Video:
    """A video file.

    Attributes:
        path: absolute.
        name: of its folder in the output.
        size, modified_ns: of the file; a later run takes a file with other values for a new video.
        fields: as in `read_frames`: what is a frame of it.
    """

    path: Path
    name: str
    size: int
    modified_ns: int
    fields: Fields = "auto"

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "video": str(self.path),
            "size": self.size,
            "modified_ns": self.modified_ns,
            "fields": self.fields,
        }


@dataclass(frozen=True, slots=True)
class Job:
    """One shot to reconstruct.

    Attributes:
        folder: of the result, absolute.
    """

    video: Video
    frames: range
    method: Method
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """Everything that the result depends on; its summary holds this."""
        frames = f"{self.frames.start}:{self.frames.stop}"
        content: dict[str, Any] = json.loads(
            json_text({**self.video.to_dict(), "frames": frames, **self.method.to_dict()})
        )
        return content

    def is_done(self) -> bool:
        """Whether the folder holds the complete result of this job."""
        return is_result_of(self.to_dict(), self.folder)


def find_videos(source: Path, fields: Fields = "auto") -> list[Video]:
    """The video file, or the video files of a folder in natural order.

    Raises:
        InputError: there is no video.
    """
    if source.is_dir():
        paths = list_files(source, VIDEO_SUFFIXES)
        if not paths:
            raise InputError(f"folder {source} holds no videos ({', '.join(s[1:] for s in VIDEO_SUFFIXES)})")
    elif source.is_file():
        paths = [source]
    else:
        problem = "is neither a file nor a folder" if source.exists() else "does not exist"
        raise InputError(f"{source} {problem}; a video file or a folder of videos is expected")
    stems = Counter(path.stem.lower() for path in paths)
    videos = []
    for path in paths:
        name = path.stem if stems[path.stem.lower()] == 1 else path.name
        try:
            status = path.stat()
        except OSError:  # a link that leads nowhere; whoever reads it says so, and the other videos go on
            videos.append(Video(path.absolute(), name, 0, 0, fields))
        else:
            videos.append(Video(path.resolve(), name, status.st_size, status.st_mtime_ns, fields))
    return videos


def shots_of(video: Video) -> list[range]:
    """The shots of a video.

    Raises:
        InputError: the video cannot be read, or all of its frames are blank.
    """
    shots = find_shots(video.path, fields=video.fields)
    if not shots:
        raise InputError(f"{video.path} holds no shot: all of its frames are blank")
    return shots


def plan_jobs(shots: Mapping[Video, Sequence[range]], method: Method, output: Path, *, several: bool) -> list[Job]:
    """One job per shot.

    Args:
        several: whether maps and masks lie in one folder per video, with the name of the video.

    Raises:
        InputError: no mask belongs to any frame.
    """
    jobs = []
    matched = False
    for video, ranges in shots.items():
        own = method.of_video(video.name) if several else method
        masks = MaskFolder(own.masks) if own.masks is not None and Path(own.masks).is_dir() else None
        things = ObjectFolder(own.objects) if own.objects not in (None, FROM_MOTION) else None
        for number, frames in enumerate(ranges, 1):
            # A shot without any mask is reconstructed without: often only shots with actors have masks.
            masked = masks is None or any(map(masks.has, frames))
            matched |= own.masks is not None and masked
            chosen = own if masked else replace(own, masks=None)
            if things is not None and not any(map(things.has, frames)):
                chosen = replace(chosen, objects=None)
            jobs.append(Job(video, frames, chosen, output.absolute() / video.name / f"shot_{number:03d}"))
    if method.masks is not None and not matched:
        raise InputError(f"no mask in {method.masks} matches a frame of a shot")
    return jobs
