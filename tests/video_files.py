"""Video files of known images, in any container and codec."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import Interpolation
from numpy.typing import NDArray

Image = NDArray[np.uint8]
# Tags of a frame that FFmpeg's enumerations name.
BT709, BT2020 = 1, 9
LIMITED, FULL = 1, 2
PQ, HLG = 16, 18


QUIET_H265 = {"x265-params": "log-level=none"}
DNXHR = {"profile": "dnxhr_hq"}

# suffix, codec, pixels, options: what cameras, phones, editors and the web hand out.
FORMATS = [
    (".mp4", "libx264", "yuv420p", {}),
    (".mp4", "libx265", "yuv420p10le", QUIET_H265),
    (".mov", "prores_ks", "yuv422p10le", {}),
    (".mov", "prores_ks", "yuva444p10le", {"profile": "4444"}),
    (".mov", "dnxhd", "yuv422p", DNXHR),
    (".mxf", "dnxhd", "yuv422p", DNXHR),
    (".mxf", "mpeg2video", "yuv422p", {}),
    (".mkv", "libx264", "yuv420p10le", {}),
    (".webm", "libvpx-vp9", "yuv420p", {}),
    (".mpg", "mpeg2video", "yuv420p", {}),
    (".m2ts", "libx264", "yuv420p", {}),
    (".ts", "mpeg2video", "yuv420p", {}),
    (".avi", "mjpeg", "yuvj420p", {}),
    (".avi", "mpeg4", "yuv420p", {}),
    (".wmv", "wmv2", "yuv420p", {}),
    (".mkv", "ffv1", "bgr0", {}),
    (".gif", "gif", "gray", {}),
]


def moving_texture(count: int, step: float = 2.0, size: tuple[int, int] = (320, 240)) -> list[Image]:
    """Smooth grey texture that moves to the left by `step` pixels a frame; `size`: width and height."""
    width, height = size
    rng = np.random.default_rng(0)
    coarse = rng.integers(30, 220, (height // 8, width // 4), dtype=np.uint8)
    wide = cv2.resize(coarse, (2 * width, height), interpolation=cv2.INTER_CUBIC)
    frames = []
    for k in range(count):
        shift = np.array([[1.0, 0.0, -step * k], [0.0, 1.0, 0.0]])
        grey = cv2.warpAffine(wide, shift, (2 * width, height), flags=cv2.INTER_CUBIC)[:, :width]
        frames.append(np.repeat(grey[:, :, None], 3, axis=2))
    return frames


def woven(moments: Sequence[Image], *, top_first: bool) -> list[Image]:
    """Interlaced frames: each holds every other line of two moments."""
    frames = []
    for earlier, later in zip(moments[::2], moments[1::2], strict=True):
        frame = earlier.copy()
        parity = 1 if top_first else 0
        frame[parity::2] = later[parity::2]
        frames.append(frame)
    return frames


def write_video(
    path: Path,
    images: Sequence[NDArray[Any]],
    codec: str = "libx264",
    pixels: str = "yuv420p",
    *,
    rate: int = 25,
    options: dict[str, str] | None = None,
    times: Sequence[int] | None = None,
    aspect: Fraction | None = None,
    rotation: int = 0,
    mirrored: bool = False,
    field_order: str | None = None,
    stereo: str | None = None,
    **tags: int,
) -> Path:
    """Write images, uint8 BGR or uint16 RGB, as a video; the path, for convenience.

    Args:
        times: of the frames, in hundredths of a second; aspect: of a pixel.
        rotation: degrees against the clock; mirrored: from side to side after it.
        field_order: "tff" or "bff" marks the frames as interlaced.
        stereo: how two views lie in a frame, as Matroska names it.
        tags: `colorspace`, `color_range`, `color_trc` of the frames.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        height, width = images[0].shape[:2]
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = width, height, pixels, 8_000_000
        if stereo is not None:
            stream.metadata["stereo_mode"] = stereo
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 100)
        if rotation or mirrored:
            stream.set_display_rotation(rotation, hflip=mirrored)
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        graph = _marked(stream, field_order, Fraction(1, rate)) if field_order else None
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24" if image.dtype == np.uint8 else "rgb48le")
            frame = frame.reformat(
                format=pixels,
                dst_colorspace=tags.get("colorspace"),
                dst_color_range=tags.get("color_range"),
                interpolation=Interpolation.BILINEAR | Interpolation.ACCURATE_RND,
            )
            for name, value in tags.items():
                setattr(frame, name, value)
            frame.pts = k if times is None else times[k]
            frame.time_base = Fraction(1, rate if times is None else 100)
            if graph is not None:
                graph.push(frame)
                frame = graph.pull()
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def marked_as_sphere(path: Path) -> Path:
    """The same MP4 file with the box that cameras for 360 degrees write into its only track."""
    name = "http://ns.google.com/videos/1.0/spherical/"
    stated = {"Spherical": "true", "Stitched": "true", "ProjectionType": "equirectangular", "StitchingSoftware": "test"}
    tags = "".join(f"<GSpherical:{key}>{value}</GSpherical:{key}>" for key, value in stated.items())
    text = f'<?xml version="1.0"?><rdf:SphericalVideo xmlns:GSpherical="{name}">{tags}</rdf:SphericalVideo>'.encode()
    content = b"uuid" + bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + text
    box = (len(content) + 4).to_bytes(4, "big") + content
    data = bytearray(path.read_bytes())
    movie = data.rfind(b"moov") - 4  # behind the frames, whose places do not change
    track = data.find(b"trak", movie) - 4
    end = track + int.from_bytes(data[track : track + 4], "big")
    data[end:end] = box
    for begin in (movie, track):
        data[begin : begin + 4] = (int.from_bytes(data[begin : begin + 4], "big") + len(box)).to_bytes(4, "big")
    path.write_bytes(data)
    return path


def interlaced(path: Path, moments: Sequence[Image], codec: str = "libx264", *, top_first: bool = True) -> Path:
    """Write moments as interlaced video, two a frame, whose frames are marked."""
    order = "tff" if top_first else "bff"
    options = {"x264-params": f"{order}=1"} if codec == "libx264" else {"flags": "+ildct+ilme"}
    frames = woven(moments, top_first=top_first)
    return write_video(path, frames, codec, options=options, field_order=order)


def _marked(stream: av.VideoStream, field_order: str, unit: Fraction) -> av.filter.Graph:
    """A filter that marks frames as interlaced."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=stream.width, height=stream.height, format=av.VideoFormat(stream.pix_fmt), time_base=unit
    )
    graph.link_nodes(source, graph.add("setfield", field_order), graph.add("buffersink")).configure()
    return graph
