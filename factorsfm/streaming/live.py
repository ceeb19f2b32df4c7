"""A source followed live: its frames are decoded beside the tracking, and every frame gives an update."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import open_camera
from factorsfm.frames.fields import Fields
from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import Source, open_source
from factorsfm.frames.raw import RawFormat
from factorsfm.priors.depth import DepthPrior, open_depth
from factorsfm.priors.depth_map import DepthKind
from factorsfm.priors.masks import MaskPrior, open_masks
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.stream import Stream
from factorsfm.support.context import Closing
from factorsfm.support.options import Options
from factorsfm.support.progress import Progress


class Live(Closing, Iterator[FrameUpdate]):
    """Updates of a source's frames; `finish` gives the reconstruction. Made by `track`.

    Attributes:
        source: says how it ended. stream: gives the trajectory as it is known now.
    """

    def __init__(self, source: Source, stream: Stream) -> None:
        self.source = source
        self.stream = stream

    def __next__(self) -> FrameUpdate:
        return self.stream.push(next(self.source))

    def finish(self, progress: Progress | None = None) -> Reconstruction:
        """Stop reading, and polish over the frames that came; errors as in `Stream.finish`."""
        with self:
            self.source.close()
            return self.stream.finish(progress)

    def close(self) -> None:
        """Stop reading, and give up what is not finished."""
        with self.stream:
            self.source.close()


def track(
    source: str | Path | int | BinaryIO | Iterable[NDArray[np.uint8] | Frame],
    *,
    camera: str | Path | pycolmap.Camera | None = None,
    depth: str | Path | DepthPrior | None = "tcmonodepth",
    depth_kind: DepthKind | str | None = None,
    masks: str | Path | MaskPrior | None = None,
    preset: str = "default",
    frames: slice | None = None,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
    raw: RawFormat | None = None,
    watch: bool = False,
    drop: bool | None = None,
) -> Live:
    """Follow a source: a pose for every frame as it arrives.

    Args:
        source, frames, fields, pixel_aspect, raw, watch, drop: see `open_source`.
        camera, depth, depth_kind, masks, preset: see `reconstruct`.

    Example:
        >>> with factorsfm.track("shot.mp4") as live:  # doctest: +SKIP
        ...     for update in live:
        ...         print(update.index, update.status, update.cam_from_world)
        ...     reconstruction = live.finish()

    Raises:
        InputError: the source, the camera or a prior cannot be used.
    """
    options = Options.preset_named(preset)
    prior = open_depth(depth, depth_kind) if options.uses_depth else None
    lens, ignored = open_camera(camera), open_masks(masks)
    opened = open_source(
        source, frames=frames, fields=fields, pixel_aspect=pixel_aspect, raw=raw, watch=watch, drop=drop
    )
    return Live(opened, Stream(lens, depth=prior, masks=ignored, options=options))
