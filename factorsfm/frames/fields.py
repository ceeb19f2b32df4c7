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
_ONE_MOMENT = 0.5  # of the difference to the next frame: two moments at even steps have 1, a still shot, too


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

    The later field then is much nearer to the earlier one of its own frame than to that of the next frame. In a still
    shot it is as near to both, and the frames count as interlaced.
    """
    first, second = (0, 1) if top_first else (1, 0)
    own = to_next = 0.0
    lumas = [_luma(frame).astype(np.float32) for frame in frames]
    for luma, following in itertools.pairwise(lumas):
        later = _between(luma, second)
        own += float(np.abs(later - luma[first::2][1 : 1 + len(later)]).mean())
        to_next += float(np.abs(later - following[first::2][1 : 1 + len(later)]).mean())
    return own < _ONE_MOMENT * to_next


def _between(luma: NDArray[np.float32], parity: int) -> NDArray[np.float32]:
    """One field, averaged to the lines of the other one from its second on."""
    lines = luma[parity::2]
    means = 0.5 * (lines[:-1] + lines[1:])
    return means[:-1] if parity == 1 else means[1:]


def _luma(frame: av.VideoFrame) -> Image:
    return np.asarray(frame.to_ndarray(format="gray"), np.uint8)
