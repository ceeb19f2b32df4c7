"""A video file opened: its container, its pictures in order, and what is wrong with one that gives none."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import av
import av.logging
from av.container import InputContainer
from av.error import FFmpegError, InvalidDataError
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from factorsfm.support.errors import InputError

_FILE = "file:"  # the protocol before a path, without which FFmpeg takes some paths for others


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
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
        if has_decoder(stream):
            stream.thread_type = "AUTO"
        yield container, stream


def decoded(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Frames from where the container stands. Damaged packets are left out, and a file may end inside of one.

    Raises:
        InputError: the file is gone, such as with the network that held it.
    """
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
    level = av.logging.get_level()
    av.logging.set_level(av.logging.WARNING)
    try:
        with av.logging.Capture() as log, opened_video(path):
            said = " ".join(message for _, _, message in log)
    finally:
        av.logging.set_level(level)
    found = re.search(r"Video: (\w+)(?: \((\w+) /)?", said)
    if found is None:
        return "unknown"
    return found[2] if found[1] == "none" and found[2] else found[1]
