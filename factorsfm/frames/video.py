"""Video files: decoded in order, from the start or from a later frame that its timestamp identifies."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from factorsfm.frames.aspect import stated_or_square
from factorsfm.frames.container import (
    announced_seconds,
    decoded,
    decoded_with_damage,
    has_decoder,
    opened_video,
    problem,
    video_streams,
)
from factorsfm.frames.fields import CombWatch, Fields, FieldSplitter, blended, is_top_first, show_one_moment
from factorsfm.frames.frame import Frame
from factorsfm.frames.picture import Orientation, Picture
from factorsfm.frames.video_damage import NoiseWatch, Numbers, warn_if_short
from factorsfm.frames.views import check_is_one_view
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (
    *(".avi", ".gif", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg"),
    *(".mpg", ".mts", ".mxf", ".ogv", ".ts", ".webm", ".wmv"),
)
_SEEK_FROM = 100  # frames: decoding fewer is faster than reading the packets of the whole file
_LEADS = (0, _SEEK_FROM)  # frames before the wanted one to jump to: TS and MPG lead past its keyframe
_COMPARED = 16  # frames at the start of the file whose timestamps must be those of its packets
_PROBED = 26  # frames of a file from which fields, their order and their moments are read
_PROGRESSIVE = 1  # order of the fields, as FFmpeg names a codec that states that there are none


@dataclass(frozen=True, slots=True)
class VideoFile:
    """What the first frames of a video file say of all.

    Attributes:
        start: time of the first frame, seconds; None if the container has no times.
        interval: seconds from a frame to the next as the container announces it, 0 if unknown.
        orientation: how images are turned upright.
        pixel_aspect: width of a shown pixel over its height.
        announced, announced_seconds: frames and length that the container announces, 0 if it does not say.
        interlaced: whether its frames hold fields of two moments; film: whether they are flagged so, but hold one.
        top_first: whether the field of the lines 0, 2, 4, ... is the earlier one.
    """

    path: Path
    start: float | None
    interval: float
    orientation: Orientation
    pixel_aspect: float
    announced: int
    announced_seconds: float
    interlaced: bool
    film: bool
    top_first: bool


def open_video(path: Path) -> VideoFile:
    """Decode the first frames of a file.

    Raises:
        InputError: the file is not a video, cannot be decoded, or shows a sphere or two views.
    """
    with opened_video(path) as (container, stream):
        several = len(video_streams(container))
        if several > 1:
            size = f"{stream.width}x{stream.height} pixels"
            logger.warning("%s holds %d videos; stream %d is used, of %s", path, several, stream.index, size)
        frames = decoded(container, stream) if has_decoder(stream) else iter(())
        first = next(frames, None)
        if first is None:
            raise InputError(f"{path} cannot be decoded as a video; {problem(path, stream)}")
        check_is_one_view(first, path)
        second = next(frames, None)
        timed = first.time is not None and second is not None and (second.time or 0.0) > first.time
        orientation = Orientation.of(first)
        aspect = stated_or_square(float(stream.sample_aspect_ratio or 1), path)
        order = int(stream.codec_context.field_order or 0)
        more = 0 if order == _PROGRESSIVE else _PROBED - 2  # to decode them takes a second in 4K
        probed = [first, *([] if second is None else [second]), *itertools.islice(frames, more)]
        flagged = [frame for frame in probed if frame.interlaced_frame]
        top_first = not flagged or is_top_first(flagged, order)
        film = bool(flagged) and show_one_moment(probed, top_first=top_first)
        if film:
            logger.info("%s is interlaced, but both fields of a frame show one moment: frames stay whole", path)
        return VideoFile(
            path=path,
            start=first.time if timed else None,
            interval=float(1 / stream.guessed_rate) if stream.guessed_rate else 0.0,
            orientation=orientation,
            pixel_aspect=1.0 / aspect if orientation.turned else aspect,
            announced=stream.frames,
            announced_seconds=announced_seconds(container, stream),
            interlaced=bool(flagged) and not film,
            film=film,
            top_first=top_first,
        )


def decode(video: VideoFile, selection: slice, fields: Fields = "auto") -> Iterator[Frame]:
    """The frames of a range.

    Where fields are taken apart each is a frame of half the lines, and counts as one: those of the first frame of the
    file are 0 and 1.

    Args:
        selection: the range, see `checked_range`.
        fields: what is done with interlaced frames. auto: apart, where they are interlaced; apart or blend: in any
            case.

    Raises:
        InputError: the file cannot be opened or read any more, or interlaced frames come after others.
    """
    apart = _are_taken_apart(video, fields)
    per_frame = 2 if apart else 1
    chosen = _Chosen(selection, per_frame)
    convert = _Converter(video, fields, FieldSplitter(video.top_first) if apart else None)
    watch = CombWatch() if fields == "auto" and not (video.interlaced or video.film) else None
    size = video.path.stat().st_size
    numbers, noise = Numbers(video.interval), NoiseWatch()
    position, frame = -1, None
    for position, frame in numbers.of(*_from(video, chosen.first_frame)):
        if chosen.is_over(position):
            break
        if watch is not None and watch.push(frame):
            raise InputError(
                f"{video.path} is interlaced before frame {position}, but not at its beginning; "
                "fields apart or blend (--fields) is expected for such a video"
            )
        noise.push(position, frame)
        wanted = chosen.of_frame(position)
        if wanted:
            yield from convert(frame, wanted)
    else:
        _warn_if_grown(position + 1, size, video.path)
        if frame is not None:
            end = (frame.time or 0.0) - (video.start or 0.0) + video.interval
            warn_if_short(video.path, (position + 1, video.announced), (end, video.announced_seconds))
    numbers.warn(video.path)
    noise.warn(video.path)


def _are_taken_apart(video: VideoFile, fields: Fields) -> bool:
    return fields == "apart" or (fields == "auto" and video.interlaced)


def are_fields(path: Path, fields: Fields) -> bool:
    """Whether what is read of a video file are fields, as `decode` reads it, not its frames.

    Raises:
        InputError: the file is not a video, or cannot be decoded.
    """
    return _are_taken_apart(open_video(path), fields)


def announced_frames(path: Path) -> int:
    """How many frames a video file says that it has, else how many packets it has for them; nothing is decoded.

    Raises:
        InputError: the file is not a video.
    """
    with opened_video(path) as (container, stream):
        return stream.frames or sum(1 for packet in container.demux(stream) if packet.size)


def count_frames(path: Path) -> int:
    """How many frames of a video file can be decoded; a frame of two fields counts as one.

    Raises:
        InputError: the file is not a video.
    """
    with opened_video(path) as (container, stream):
        return sum(1 for _ in decoded(container, stream))


@dataclass(frozen=True, slots=True)
class _Chosen:
    """Which pictures of which frames of the file are wanted: one of each frame, or two fields."""

    selection: slice
    per_frame: int

    @property
    def first_frame(self) -> int:
        """Position in the file of the first frame that is needed."""
        return int(self.selection.start) // self.per_frame

    def is_over(self, position: int) -> bool:
        """Whether nothing is wanted from this frame on."""
        return self.selection.stop is not None and position * self.per_frame >= self.selection.stop

    def of_frame(self, position: int) -> list[int]:
        """Indices of the wanted pictures of a frame."""
        start, stop, step = self.selection.start, self.selection.stop, self.selection.step
        indices = range(position * self.per_frame, (position + 1) * self.per_frame)
        return [i for i in indices if i >= start and (stop is None or i < stop) and (i - start) % step == 0]


class _Converter:
    """Makes frames of what was decoded; `splitter`: where fields are taken apart."""

    def __init__(self, video: VideoFile, fields: Fields, splitter: FieldSplitter | None) -> None:
        self._video, self._blend, self._splitter = video, fields == "blend", splitter
        self._picture = Picture()

    def __call__(self, frame: av.VideoFrame, indices: list[int]) -> Iterator[Frame]:
        video, splitter = self._video, self._splitter
        time = None if video.start is None or frame.time is None else frame.time - video.start
        if splitter is None:
            image = self._picture.bgr(frame)
            image = video.orientation.applied(blended(image) if self._blend else image)
            yield Frame(indices[0], image, f"{indices[0]:06d}", time, pixel_aspect=video.pixel_aspect)
            return
        fields = splitter.split(frame)
        lines = frame.height // 2
        aspect = video.pixel_aspect * (2.0 if video.orientation.turned else 0.5)
        for index in indices:
            position = index % 2
            image = splitter.centered(self._picture.bgr(fields[position])[:lines], position)
            moment = None if time is None else time + 0.5 * position * self._interval(frame)
            image = video.orientation.applied(image)
            yield Frame(index, image, f"{index:06d}", moment, pixel_aspect=aspect, is_field=True)

    def _interval(self, frame: av.VideoFrame) -> float:
        """Seconds that a frame is shown."""
        return float(frame.duration * frame.time_base) if frame.duration and frame.time_base else self._video.interval


def _warn_if_grown(frames: int, size: int, path: Path) -> None:
    """Log a warning if a file has become longer while its frames were read; size: before that, bytes."""
    with suppress(OSError):
        if path.stat().st_size > size:
            logger.warning("%s: more was written to it while it was read; its first %d frames are used", path, frames)


def _from(video: VideoFile, position: int) -> tuple[int, Iterator[tuple[av.VideoFrame, bool]]]:
    """Frames, and the number of the first: all, or from a late one on where it is found without decoding all before it.

    Neither the frame count of a container nor its index can be trusted. But the packets of the file hold the timestamps
    of all frames, which are read without decoding, and the timestamp of the frame that is reached identifies it.
    """
    late = video.start is not None and position >= _SEEK_FROM
    status = video.path.stat()
    times = _frame_times(video.path, status.st_size, status.st_mtime_ns) if late else np.zeros(0, np.int64)
    for lead in _LEADS if position < len(times) else ():
        frames = _frames(video.path, int(times[position - lead]), int(times[position]))
        first = next(frames, None)
        if first is not None:
            return position, itertools.chain([first], frames)
    return 0, _frames(video.path)


def _frames(path: Path, aim: int | None = None, wanted: int = 0) -> Iterator[tuple[av.VideoFrame, bool]]:
    """All frames, as `decoded_with_damage` gives them.

    Args:
        aim, wanted: timestamps: those from `wanted` on, after a jump to `aim`; none if it is not found so.
    """
    with opened_video(path) as (container, stream):
        frames = decoded_with_damage(container, stream)
        if aim is not None:
            try:
                container.seek(aim, stream=stream)
            except FFmpegError:
                return
            frames = itertools.dropwhile(lambda found: found[0].pts is None or found[0].pts < wanted, frames)
            first = next(frames, None)
            if first is None or first[0].pts != wanted or first[0].is_corrupt:
                return
            yield first
        yield from frames


@lru_cache(8)
def _frame_times(path: Path, size: int, modified_ns: int) -> NDArray[np.int64]:
    """Timestamps of all frames of a file in its own unit, from its packets; empty if they do not identify the frames.

    They do not if two are equal, or if an edit list hides packets, so that the first decoded frames have other
    timestamps, or if packets are damaged or missing.

    Args:
        size, modified_ns: of the file now; a file that changes is read again.
    """
    with opened_video(path) as (container, stream):
        packets = [None if packet.is_corrupt else packet.pts for packet in container.demux(stream) if packet.size]
    with opened_video(path) as (container, stream):
        first = [frame.pts for frame in itertools.islice(decoded(container, stream), _COMPARED)]
    if any(time is None for time in (*packets, *first)):
        return np.zeros(0, np.int64)
    times = np.sort(np.array(packets, np.int64))
    agree = np.array_equal(times[: len(first)], np.array(first, np.int64))
    return times if agree and (np.diff(times) > 0).all() else times[:0]
