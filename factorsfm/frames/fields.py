"""Interlaced video: frames that hold two fields, every other line each, of two moments.

A frame of two moments is combed where something moves, and is never used whole. Its fields are taken apart into images
of half the lines, or blended into one image of all lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import av
import cv2
import numpy as np
from av.filter import Graph
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Fields = Literal["auto", "apart", "blend"]

# A line of a field lies a quarter of a line above or below the middle of the two lines that it stands for. Catmull-Rom
# weights of the four nearest lines for a point a quarter of a line below the second.
_QUARTER = np.array([-0.0703125, 0.8671875, 0.2265625, -0.0234375])
_BLEND = np.array([0.25, 0.5, 0.25])  # a line of one field, and the mean of its neighbours of the other
_ONE_MOMENT = 0.25  # mean moment of the later fields, in frames: 0 of film, 0.5 of two moments at even steps
# Few pairs of frames tell less, and a video is refused by them: 4 pairs at least, and 24 at most.
_TWO_MOMENTS, _TELLING, _WATCHED = 0.35, 4, 24
_STRONGEST = 0.99  # quantile of the motion from which pixels tell moments: grain and compression move the others
_STILL = 3.0  # grey levels: grain and compression make as much


class FieldSplitter:
    """Takes the fields of a video's frames apart.

    Args:
        top_first: whether the field of the lines 0, 2, 4, ... is the earlier one.
    """

    def __init__(self, top_first: bool) -> None:
        self._order = ("top", "bottom") if top_first else ("bottom", "top")
        self._graphs: dict[str, Graph] = {}

    def split(self, frame: av.VideoFrame) -> list[av.VideoFrame]:
        """The two fields in order of time, each of half the lines; planes of colour are split, too."""
        return [self._field(frame, which) for which in self._order]

    def _field(self, frame: av.VideoFrame, which: str) -> av.VideoFrame:
        if which not in self._graphs:
            graph = self._graphs[which] = Graph()
            source = graph.add_buffer(
                width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
            )
            graph.link_nodes(source, graph.add("field", which), graph.add("buffersink")).configure()
        self._graphs[which].push(frame)
        field = self._graphs[which].pull()
        assert isinstance(field, av.VideoFrame)
        return field

    def centered(self, image: Image, position: int) -> Image:
        """The image of a field on the lines that both fields share: line k lies between the lines 2k and 2k + 1.

        Both are moved by a quarter of a line, so that they are equally sharp.

        Args:
            position: 0 for the earlier field, 1 for the later one.
        """
        kernel, anchor = (_QUARTER, 1) if self._order[position] == "top" else (_QUARTER[::-1], 2)
        moved = cv2.filter2D(image, -1, kernel[:, None], anchor=(0, anchor), borderType=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.uint8)


def blended(image: Image) -> Image:
    """A whole frame, its fields blended: each line is half of one field and half of the other."""
    return np.asarray(cv2.filter2D(image, -1, _BLEND[:, None], borderType=cv2.BORDER_REPLICATE), np.uint8)


def is_top_first(frames: Sequence[av.VideoFrame], field_order: int) -> bool:
    """Whether the top field is the earlier one, from the frames' flags, or from the container's where these say none.

    Args:
        field_order: of the codec, as in FFmpeg.
    """
    for frame in frames:
        first = _first_field(frame)
        luma = _luma(frame)
        top, bottom = (np.abs(luma[k::2][: len(first)].astype(np.int16) - first).max() for k in (0, 1))
        if top != bottom:
            return bool(top < bottom)
    return field_order not in (3, 4)  # the bottom field is shown first


def _first_field(frame: av.VideoFrame) -> NDArray[np.int16]:
    """Luma of the field that FFmpeg shows first; PyAV does not tell which it is."""
    graph = Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
    graph.link_nodes(source, graph.add("separatefields"), graph.add("buffersink")).configure()
    graph.push(frame)
    graph.push(None)
    field = graph.pull()
    assert isinstance(field, av.VideoFrame)
    return _luma(field).astype(np.int16)


def show_one_moment(frames: Sequence[av.VideoFrame], *, top_first: bool) -> bool:
    """Whether the fields of interlaced frames are of one moment each, as where film is stored as interlaced video.

    The later field of a frame is then of the moment of the earlier one; else it lies in the middle between this and
    that of the next frame. A still shot does not tell, and its frames count as interlaced.
    """
    pairs = [pair for pair in itertools.pairwise(frames) if pair[0].interlaced_frame]
    moments = [_moment(*pair, top_first=top_first) for pair in pairs]
    told = [moment for moment in moments if moment is not None]
    return bool(told) and float(np.mean(told)) < _ONE_MOMENT


class CombWatch:
    """Watches for frames of two moments in a video that began without frames flagged as interlaced."""

    def __init__(self) -> None:
        self._before: av.VideoFrame | None = None
        self._told: list[float] = []

    def push(self, frame: av.VideoFrame) -> bool:
        """Whether the frames up to the next one have shown that flagged ones among them hold two moments."""
        before, self._before = self._before, frame if frame.interlaced_frame else None
        if before is not None and len(self._told) < _WATCHED and before.format.name == frame.format.name:
            moment = _moment(before, frame, top_first=is_top_first([before], 0))
            self._told += [] if moment is None else [moment]
        return len(self._told) >= _TELLING and float(np.mean(self._told)) > _TWO_MOMENTS


def _moment(frame: av.VideoFrame, following: av.VideoFrame, *, top_first: bool) -> float | None:
    """When the later field of a frame was seen: 0 with its earlier field, 1 with that of the next frame.

    The difference between the two earlier fields, which have the same lines, is motion alone. The share of it that the
    later field has gone through is found by least squares: what its other lines show besides, the vertical detail of
    the picture, is as near to both and does not count.

    Returns:
        0 to 1; None where nothing moves.
    """
    luma, luma_after = (_luma(image).astype(np.float32) for image in (frame, following))
    first = 0 if top_first else 1  # line of the earlier fields
    before, after = (0.5 * (lines[first::2][:-1] + lines[first::2][1:]) for lines in (luma, luma_after))
    later = luma[1 - first :: 2][first:][: len(before)]
    before, after = before[: len(later)], after[: len(later)]
    motion = after - before
    strength = np.abs(motion)
    least = float(np.quantile(strength, _STRONGEST))
    if least < _STILL:
        return None
    moved = strength >= least
    share = float((motion * (later - before))[moved].sum() / (motion[moved] ** 2).sum())
    return min(max(share, 0.0), 1.0)


def _luma(frame: av.VideoFrame) -> Image:
    return np.asarray(frame.to_ndarray(format="gray"), np.uint8)
