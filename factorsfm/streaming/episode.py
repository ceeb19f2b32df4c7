"""A film of several shots: cuts are found while it streams, and every shot becomes a reconstruction of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.cuts import CutDetector
from factorsfm.frames.frame import Frame, as_frame
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.masks import MaskPrior
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.stream import Stream
from factorsfm.support.context import Closing
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options

_CERTAIN = 5  # frames of a shot after which the one before cannot come back


@dataclass(frozen=True, slots=True)
class ShotResult:
    """What became of one shot.

    Attributes:
        first, last: index of its first and last frame.
        reconstruction: None where the shot cannot be reconstructed.
        reason: why not, with numbers; empty where it can.
        frames: statuses of a shot that cannot be reconstructed.
    """

    first: int
    last: int
    reconstruction: Reconstruction | None
    reason: str = ""
    frames: Sequence[FrameResult] = ()


class Episode(Closing):
    """Incremental reconstruction of a film, a `Stream` for every shot.

    Args:
        camera: the lens of all shots; None guesses it for each.
        depth, masks, options: see `Stream`.
        finished: called with each result as soon as it is there, in order of time, from a thread of its own; what it
            raises is raised by `finish`.

    Example:
        >>> episode = factorsfm.Episode(depth=factorsfm.DepthModel("model.onnx"))  # doctest: +SKIP
        >>> for frame in factorsfm.read_frames("film.mp4"):  # doctest: +SKIP
        ...     update = episode.push(frame)
        >>> for shot in episode.finish():  # doctest: +SKIP
        ...     print(shot.first, shot.last, shot.reason or shot.reconstruction.kind)
    """

    def __init__(
        self,
        camera: pycolmap.Camera | None = None,
        *,
        depth: DepthPrior | None = None,
        masks: MaskPrior | None = None,
        options: Options | None = None,
        finished: Callable[[ShotResult], None] | None = None,
    ) -> None:
        self._finished = finished
        self._camera, self._depth, self._masks, self._options = camera, depth, masks, options
        self._detector = CutDetector()
        self._streams: dict[int, Stream] = {}
        self._shot = 0
        self._pushed = 0
        self._worker = ThreadPoolExecutor(1, "factorsfm-shots")
        self._results: list[Future[ShotResult]] = []

    def push(self, frame: Frame | NDArray[np.uint8]) -> FrameUpdate:
        """Take the next frame; `FrameUpdate.shot` says to which shot it belongs. Errors as in `Stream.push`."""
        frame = as_frame(frame, self._pushed)
        shot = self._detector.push(frame).shot
        self._pushed += 1
        if shot is not None and shot != self._shot:
            for number in [n for n in self._streams if n > shot]:  # they were an interruption
                self._streams.pop(number).close()
            self._shot = shot
        if self._shot not in self._streams:
            self._streams[self._shot] = Stream(
                self._camera, depth=self._depth, masks=self._masks, options=self._options
            )
        stream = self._streams[self._shot]
        try:
            update = stream.push(frame)
        except Exception:
            if not stream.frames:  # a shot begins with the first frame that is taken
                self._streams.pop(self._shot).close()
            raise
        if len(stream.frames) == _CERTAIN:
            for number in sorted(self._streams):
                if number < self._shot:
                    self._results.append(self._worker.submit(self._finish, self._streams.pop(number), None))
        return replace(update, shot=self._shot)

    @property
    def stream(self) -> Stream:
        """That of the shot to which the newest frame belongs."""
        return self._streams[self._shot]

    def finish(self, progress: Callable[[str, int, int | None], None] | None = None) -> list[ShotResult]:
        """Polish what is not polished yet; all shots in order of time."""
        self._results += [
            self._worker.submit(self._finish, self._streams.pop(number), progress) for number in sorted(self._streams)
        ]
        self._worker.shutdown()
        return [result.result() for result in self._results]

    def close(self) -> None:
        """Give up what is not finished."""
        self._worker.shutdown(wait=False, cancel_futures=True)
        for stream in self._streams.values():
            stream.close()

    def _finish(self, stream: Stream, progress: Callable[[str, int, int | None], None] | None) -> ShotResult:
        first, last = stream.frames[0].index, stream.frames[-1].index
        try:
            result = ShotResult(first, last, stream.finish(progress))
        except ReconstructionError as error:
            result = ShotResult(first, last, None, str(error), error.frames)
        if self._finished is not None:
            self._finished(result)
        return result
