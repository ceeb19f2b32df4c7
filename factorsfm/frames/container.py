"""A video file opened: its container, its pictures in order, and what is wrong with one that gives none."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import av
import av.logging
from av.container import InputContainer
from av.error import FFmpegError, InvalidDataError
from av.stream import Disposition, Stream
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from factorsfm.support.errors import InputError

_FILE = "file:"  # the protocol before a path, without which FFmpeg takes some paths for others

_TEXT = ("ansi", "bintext", "idf", "xbin")  # codecs by which FFmpeg draws text as a picture


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container and its best video stream, never a cover. A file that names others can name none of a network.

    Raises:
        InputError: it cannot be read, is no container, text, a single image, or holds no video.
    """
    try:
        container = av.open(f"{_FILE}{path}", options={"protocol_whitelist": "file"})
    except (FFmpegError, OSError, ValueError) as error:
        try:
            path.open("rb").close()
        except OSError as reason:
            raise InputError(f"{path} cannot be read: {reason.strerror}") from error
        raise InputError(
            f"{path} cannot be decoded as a video; it is damaged, still being written, or not a video"
        ) from error
    with container:
        if _is_image(container):
            raise InputError(f"{path} is a single image; a video file or a folder of images is expected")
        stream = container.streams.best("video")
        if stream is None or _is_cover(stream):
            raise InputError(f"{path} cannot be decoded as a video; it holds no picture")
        assert isinstance(stream, VideoStream)
        if has_decoder(stream):
            if stream.codec_context.name in _TEXT:
                raise InputError(f"{path} cannot be decoded as a video; it is text")
            stream.thread_type = "AUTO"
        yield container, stream


def _is_image(container: InputContainer) -> bool:
    return container.format.name == "image2" or container.format.name.endswith("_pipe")


def _is_cover(stream: Stream) -> bool:
    return bool(stream.disposition & Disposition.attached_pic)


def video_streams(container: InputContainer) -> list[VideoStream]:
    """All video of a file, without covers."""
    return [stream for stream in container.streams.video if not _is_cover(stream)]


def decoded(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Frames from where the container stands, without corrupt ones.

    Raises:
        InputError: see `decoded_with_damage`.
    """
    return (frame for frame, _ in decoded_with_damage(container, stream) if not frame.is_corrupt)


def decoded_with_damage(container: InputContainer, stream: VideoStream) -> Iterator[tuple[av.VideoFrame, bool]]:
    """Frames from where the container stands, and whether damage was met since the one before.

    Damaged packets are left out, and a file may end inside of one.

    Raises:
        InputError: the file is gone, such as with the network that held it.
    """
    damaged = False
    for packet, following in itertools.pairwise(itertools.chain(_packets(container, stream), [None])):
        damaged |= packet is None or packet.is_corrupt
        # One that the end of the file cuts off would take those with it that are decoded beside it.
        if packet is not None and packet.is_corrupt and (following is None or not following.size):
            continue
        try:
            frames = _packet_frames(stream, packet)
        except InvalidDataError:
            damaged = True
            continue
        except FFmpegError as error:
            _refuse_if_gone(container, error)
            return
        for frame in frames:
            yield frame, damaged or frame.is_corrupt
            damaged = False


def _packets(container: InputContainer, stream: VideoStream) -> Iterator[av.Packet[VideoStream] | None]:
    """Packets from where the container stands, and None where it breaks off: the decoder still holds frames then."""
    try:
        yield from container.demux(stream)
    except FFmpegError as error:
        _refuse_if_gone(container, error)
        yield None


def _packet_frames(stream: VideoStream, packet: av.Packet[VideoStream] | None) -> list[av.VideoFrame]:
    return stream.decode(packet)


def _refuse_if_gone(container: InputContainer, error: FFmpegError) -> None:
    path = Path(container.name.removeprefix(_FILE))
    try:
        path.stat()
    except OSError as gone:
        raise InputError(f"{path} cannot be read any more: {gone.strerror}") from error


def announced_seconds(container: InputContainer, stream: VideoStream) -> float:
    """How long the container says that the video is, 0 if it does not say or means something else beside it."""
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    stated = re.fullmatch(r"(\d+):(\d+):([\d.]+)", stream.metadata.get("DURATION", ""))
    if stated is not None:
        return 3600.0 * int(stated[1]) + 60.0 * int(stated[2]) + float(stated[3])
    return (container.duration or 0) / av.time_base if len(container.streams) == 1 else 0.0


def problem(path: Path, stream: VideoStream) -> str:
    """What is wrong with a file that gives no frame."""
    cure = "convert it to H.264"
    if has_decoder(stream):
        return f"its codec ({stream.codec_context.name}) finds no picture in it: it is damaged; {cure}"
    return f"FFmpeg has no decoder for its codec ({_unknown_codec(path)}); {cure}"


def has_decoder(stream: VideoStream) -> bool:
    return cast("VideoCodecContext | None", stream.codec_context) is not None


def _unknown_codec(path: Path) -> str:
    """Name or tag of a codec without decoder, which FFmpeg says in its log alone."""
    level, once = av.logging.get_level(), av.logging.get_skip_repeated()
    av.logging.set_level(av.logging.WARNING)
    av.logging.set_skip_repeated(False)  # another file may have said the same
    try:
        with av.logging.Capture() as log, opened_video(path):
            said = " ".join(message for _, _, message in log)
    finally:
        av.logging.set_level(level)
        av.logging.set_skip_repeated(once)
    found = re.search(r"Video: (\w+)(?: \((\w+) /)?", said)
    if found is None:
        return "unknown"
    return found[2] if found[1] == "none" and found[2] else found[1]
