"""What ``factorsfm stream`` writes: the result of a shot, or those of the shots of a film."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorsfm.cli.command import as_given, write_result
from factorsfm.frames.live_sources import Source
from factorsfm.report.result_folder import write_failure, write_folder
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import verdict
from factorsfm.streaming.episode import ShotResult
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.progress import Progress
from factorsfm.viewer.viewer import Viewer


class StreamResults:
    """Writes what has come of the frames.

    Args:
        begin: when the command began, by `time.perf_counter`.
        inputs: what is written beside the options of a result, see `api.input_options`.
    """

    def __init__(self, arguments: argparse.Namespace, source: Source, begin: float, inputs: Mapping[str, Any]) -> None:
        self._inputs = inputs
        self._output: Path = arguments.output
        self._source = source
        self._begin = begin
        self._said: list[str] = []  # of the shots of a film
        self._reconstructed = 0  # of these
        self._given = as_given(arguments)
        if "://" in arguments.source:  # it may hold a password
            self._given["source"] = source.name

    def write(self, stream: Stream, viewer: Viewer, progress: Progress) -> str:
        """Finish a stream and write its result, or the reason why there is none; what to say of it."""
        try:
            reconstruction = stream.finish(progress)
        except ReconstructionError as error:
            write_failure(self._output, str(error), error.frames, self._given, self._seconds())
            raise
        viewer.log_result(reconstruction)
        return write_result(self._completed(reconstruction), self._output, progress)

    def write_shot(self, shot: ShotResult) -> None:
        """Write what has become of the next shot of a film."""
        folder = self._output / f"shot-{len(self._said) + 1:03d}"
        if shot.reconstruction is None:
            write_failure(folder, shot.reason, shot.frames, self._given, self._seconds())
        else:
            write_folder(self._completed(shot.reconstruction), folder)
            self._reconstructed += 1
        said = verdict(shot.reconstruction) if shot.reconstruction else f"not reconstructed: {shot.reason}"
        self._said.append(f"{folder.name}, frames {shot.first} to {shot.last}: {said}.")

    def conclude(self) -> str:
        """What to say of the shots of a film, all of which have been written."""
        if not self._reconstructed:
            raise ReconstructionError(f"none of {len(self._said)} shots could be reconstructed; {self._said[0]}")
        return "\n".join([*self._said, f"Results in {self._output}"])

    def _completed(self, reconstruction: Reconstruction) -> Reconstruction:
        if self._source.broke_off:
            reconstruction.notes.append(f"{self._source.ended[0].upper()}{self._source.ended[1:]}.")
        if self._source.dropped:
            reconstruction.notes.append(f"Frames dropped because tracking was slower: {self._source.dropped}.")
        reconstruction.seconds |= self._seconds()
        reconstruction.options |= {"source": self._given["source"], **self._inputs}
        return reconstruction

    def _seconds(self) -> dict[str, float]:
        return {"total": time.perf_counter() - self._begin}
