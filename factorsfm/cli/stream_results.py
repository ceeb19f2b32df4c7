"""The results of ``factorsfm stream``: of one shot, or of every shot of a film."""

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
    """Writes the results.

    Args:
        begin: `time.perf_counter` at the start of the command.
        inputs: further options of the results, see `inputs.input_options`.
    """

    def __init__(self, arguments: argparse.Namespace, source: Source, begin: float, inputs: Mapping[str, Any]) -> None:
        self._inputs = inputs
        self._output: Path = arguments.output
        self._source = source
        self._begin = begin
        self._said: list[str] = []  # sentences on the shots
        self._reconstructed = 0  # number of shots
        self._given = as_given(arguments)
        if "://" in arguments.source:  # it may hold a password
            self._given["source"] = source.name
        elif (path := Path(arguments.source)).exists():
            self._given["source"] = str(path.absolute())

    def write(self, stream: Stream, viewer: Viewer, progress: Progress) -> str:
        """Finish a stream, write its result or the reason of the failure, and return the sentences for the user."""
        try:
            reconstruction = stream.finish(progress)
        except ReconstructionError as error:
            write_failure(self._output, str(error), error.frames, self._given, self._seconds())
            raise
        viewer.log_result(reconstruction)
        return write_result(self._completed(reconstruction), self._output, progress)

    def write_shot(self, shot: ShotResult) -> None:
        """Write the result of the next shot of a film."""
        folder = self._output / f"shot-{len(self._said) + 1:03d}"
        if shot.reconstruction is None:
            write_failure(folder, shot.reason, shot.frames, self._given, self._seconds())
        else:
            write_folder(self._completed(shot.reconstruction), folder)
            self._reconstructed += 1
        said = verdict(shot.reconstruction) if shot.reconstruction else f"not reconstructed: {shot.reason}"
        self._said.append(f"{folder.name}, frames {shot.first} to {shot.last}: {said}.")

    def conclude(self) -> str:
        """The sentences for the user, after all shots of a film."""
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
