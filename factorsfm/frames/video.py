"""Video files: decoded in order, from the start or from a later frame that its timestamp identifies."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import av
import av.logging
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError, InvalidDataError
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream
from numpy.typing import NDArray

from factorsfm.frames.fields import Fields, FieldSplitter, blended, is_top_first, show_one_moment
from factorsfm.frames.frame import Frame
from factorsfm.frames.picture import Orientation, Picture
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (
    *(".avi", ".gif", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg"),
    *(".mpg", ".mts", ".mxf", ".ogv", ".ts", ".webm", ".wmv"),
)
_SEEK_FROM = 100  # frames: decoding fewer is faster than reading the packets of the whole file
_COMPARED = 16  # frames at the start of the file whose timestamps must be those of its packets
_PROBED = 24  # frames of an interlaced file from which the order and the moments of its fields are read
_FILE = "file:"  # the protocol before a path, without which FFmpeg takes some paths for others
_ANNOUNCED_SHARE = 0.95  # of the frames that the container announces, which is not exact


@dataclass(frozen=True, slots=True)
class VideoFile:
    """What the first frames of a video file say of all.

    Attributes:
        start: time of the first frame, seconds; None if the container has no times.
        interval: seconds from a frame to the next as the container announces it, 0 if unknown.
        orientation: how images are turned upright.
        pixel_aspect: width of a shown pixel over its height.
        interlaced: whether its frames hold fields of two moments; top_first: which of them is the earlier one.
    """

    path: Path
    start: float | None
    interval: float
    orientation: Orientation
    pixel_aspect: float
    interlaced: bool
    top_first: bool


def open_video(path: Path) -> VideoFile:
    """Decode the first frames of a file.

    Raises:
        InputError: the file is not a video, or cannot be decoded.
    """
    with _opened(path) as (container, stream):
        frames = _decoded(container, stream) if _has_decoder(stream) else iter(())
        first = next(frames, None)
        if first is None:
            raise InputError(f"{path} cannot be decoded as a video; {_problem(path, stream)}")
        second = next(frames, None)
        timed = first.time is not None and second is not None and (second.time or 0.0) > first.time
        orientation = Orientation.of(first)
        aspect = float(stream.sample_aspect_ratio or 1) or 1.0
        order = int(stream.codec_context.field_order or 0)
        probed = [first, *([] if second is None else [second])]
        interlaced = any(frame.interlaced_frame for frame in probed)
        if interlaced:
            probed += itertools.islice(frames, _PROBED)
        top_first = not interlaced or is_top_first(probed, order)
        if interlaced and show_one_moment(probed, top_first=top_first):
            logger.info("%s is interlaced, but both fields of a frame show one moment: frames stay whole", path)
            interlaced = False
        return VideoFile(
            path=path,
            start=first.time if timed else None,
            interval=float(1 / stream.guessed_rate) if stream.guessed_rate else 0.0,
            orientation=orientation,
            pixel_aspect=1.0 / aspect if orientation.turned else aspect,
            interlaced=interlaced,
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
        InputError: the file cannot be opened or read any more.
    """
    apart = _are_taken_apart(video, fields)
    per_frame = 2 if apart else 1
    chosen = _Chosen(selection, per_frame)
    convert = _Converter(video, fields, FieldSplitter(video.top_first) if apart else None)
    with _opened(video.path) as (container, stream):
        frames = _from(container, stream, video, chosen.first_frame)
        if frames is None:
            container.seek(0, stream=stream)
            frames = enumerate(_decoded(container, stream))
        size = video.path.stat().st_size
        position = -1
        for position, frame in frames:
            if chosen.is_over(position):
                return
            wanted = chosen.of_frame(position)
            if wanted:
                yield from convert(frame, wanted)
        _warn_if_grown(position + 1, size, video.path)
        _warn_if_short(position + 1, stream.frames, video.path)


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
    with _opened(path) as (container, stream):
        return stream.frames or sum(1 for packet in container.demux(stream) if packet.size)


def count_frames(path: Path) -> int:
    """How many frames of a video file can be decoded; a frame of two fields counts as one.

    Raises:
        InputError: the file is not a video.
    """
    with _opened(path) as (container, stream):
        return sum(1 for _ in _decoded(container, stream))


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


@contextmanager
def _opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container and its video. A file that names others, as a playlist does, can name none of a network.

    Raises:
        InputError: it is no container, or holds no video.
    """
    try:
        container = av.open(f"{_FILE}{path}", options={"protocol_whitelist": "file"})
    except (FFmpegError, OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be decoded as a video; it is damaged, still being written, or not a video"
        ) from error
    with container:
        if not container.streams.video:
            raise InputError(f"{path} cannot be decoded as a video; it holds no picture")
        stream = container.streams.video[0]
        yield container, stream


def _decoded(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Frames from where the container stands. Damaged packets are left out, and a file may end inside of one.

    Raises:
        InputError: the file is gone, such as with the network that held it.
    """
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
            if packet is None:
                return
            frames = _packet_frames(packet)
        except InvalidDataError:
            continue
        except FFmpegError as error:
            path = Path(container.name.removeprefix(_FILE))
            try:
                path.stat()
            except OSError as gone:
                raise InputError(f"{path} cannot be read any more: {gone.strerror}") from error
            return
        yield from frames


def _packet_frames(packet: av.Packet[VideoStream]) -> list[av.VideoFrame]:
    return packet.decode()


def _problem(path: Path, stream: VideoStream) -> str:
    """What is wrong with a file that gives no frame."""
    cure = "convert it to H.264"
    if _has_decoder(stream):
        return f"its codec ({stream.codec_context.name}) finds no picture in it: it is damaged; {cure}"
    return f"FFmpeg has no decoder for its codec ({_unknown_codec(path)}); {cure}"


def _has_decoder(stream: VideoStream) -> bool:
    return cast("VideoCodecContext | None", stream.codec_context) is not None


def _unknown_codec(path: Path) -> str:
    """Name or tag of a codec without decoder, which FFmpeg says in its log alone."""
    level = av.logging.get_level()
    av.logging.set_level(av.logging.WARNING)
    try:
        with av.logging.Capture() as log, _opened(path):
            said = " ".join(message for _, _, message in log)
    finally:
        av.logging.set_level(level)
    found = re.search(r"Video: (\w+)(?: \((\w+) /)?", said)
    if found is None:
        return "unknown"
    return found[2] if found[1] == "none" and found[2] else found[1]


def _warn_if_short(frames: int, announced: int, path: Path) -> None:
    """Log a warning if a file has clearly fewer frames than its container announces."""
    if frames < _ANNOUNCED_SHARE * announced - 1.0:
        logger.warning(
            "%s: only %d of the %d frames that the container announces can be read; the others are damaged, missing, "
            "or hidden by an edit",
            path, frames, announced,
        )  # fmt: skip


def _warn_if_grown(frames: int, size: int, path: Path) -> None:
    """Log a warning if a file has become longer while its frames were read; size: before that, bytes."""
    with suppress(OSError):
        if path.stat().st_size > size:
            logger.warning("%s: more was written to it while it was read; its first %d frames are used", path, frames)


def _from(
    container: InputContainer, stream: VideoStream, video: VideoFile, position: int
) -> Iterator[tuple[int, av.VideoFrame]] | None:
    """Positions and frames, all or from a late one on; None if the late one was not found.

    Neither the frame count of a container nor its index can be trusted. But the packets of the file hold the timestamps
    of all frames, which are read without decoding, and the timestamp of the frame that is reached identifies it.
    """
    if video.start is None or position < _SEEK_FROM:
        return enumerate(_decoded(container, stream))
    status = video.path.stat()
    times = _frame_times(video.path, status.st_size, status.st_mtime_ns)
    if position >= len(times):
        return None
    try:
        container.seek(int(times[position]), stream=stream)
    except FFmpegError:
        return None
    frames = _decoded(container, stream)
    reached = next((frame for frame in frames if frame.pts is not None and frame.pts >= times[position]), None)
    if reached is None or reached.pts != times[position]:
        return None
    return enumerate(itertools.chain([reached], frames), position)


@lru_cache(8)
def _frame_times(path: Path, size: int, modified_ns: int) -> NDArray[np.int64]:
    """Timestamps of all frames of a file in its own unit, from its packets; empty if they do not identify the frames.

    They do not if two are equal, or if an edit list hides packets, so that the first decoded frames have other
    timestamps.

    Args:
        size, modified_ns: of the file now; a file that changes is read again.
    """
    with _opened(path) as (container, stream):
        packets = [packet.pts for packet in container.demux(stream) if packet.size]
    with _opened(path) as (container, stream):
        first = [frame.pts for frame in itertools.islice(_decoded(container, stream), _COMPARED)]
    if any(time is None for time in (*packets, *first)):
        return np.zeros(0, np.int64)
    times = np.sort(np.array(packets, np.int64))
    agree = np.array_equal(times[: len(first)], np.array(first, np.int64))
    return times if agree and (np.diff(times) > 0).all() else times[:0]
