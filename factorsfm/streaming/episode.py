"""A film of several shots: cuts are found while it streams, and every shot becomes a reconstruction of its own."""

from __future__ import annotations

from collections import deque
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
from factorsfm.support.progress import Progress

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
        finished: takes each result as soon as it is there, in order of time, from a thread of its own, so that a film
            of any length needs the memory of few shots; what it raises is raised by `finish`.

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
        self._ended: deque[Stream] = deque()  # streams of shots that wait for the worker
        self._results: list[Future[ShotResult | None]] = []

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
                    self._end(number, None)
        return replace(update, shot=self._shot)

    @property
    def stream(self) -> Stream:
        """That of the shot to which the newest frame belongs."""
        return self._streams[self._shot]

    def finish(self, progress: Progress | None = None) -> list[ShotResult]:
        """Polish what is not polished yet.

        Returns:
            All shots in order of time; none where `finished` has taken them.
        """
        with self:
            for number in sorted(self._streams):
                self._end(number, progress)
            self._worker.shutdown()
            results = [result.result() for result in self._results]
            return [result for result in results if result is not None]

    def close(self) -> None:
        """Give up what is not finished, but for a shot that is being polished: it is waited for."""
        self._worker.shutdown(cancel_futures=True)
        for stream in (*self._ended, *self._streams.values()):
            stream.close()

    def _end(self, number: int, progress: Progress | None) -> None:
        """No further frame belongs to a shot."""
        self._ended.append(self._streams.pop(number))
        self._results.append(self._worker.submit(self._finish, progress))

    def _finish(self, progress: Progress | None) -> ShotResult | None:
        """Polish the next shot that has ended; its result, if nobody else takes it."""
        stream = self._ended.popleft()
        first, last = stream.frames[0].index, stream.frames[-1].index
        try:
            result = ShotResult(first, last, stream.finish(progress))
        except ReconstructionError as error:
            result = ShotResult(first, last, None, str(error), error.frames)
        if self._finished is None:
            return result
        self._finished(result)
        return None
