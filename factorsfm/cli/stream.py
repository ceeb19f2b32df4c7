"""``factorsfm stream``: the arguments, and what they do."""

from __future__ import annotations

import argparse
import logging
import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from factorsfm.api import check_matched, input_options
from factorsfm.camera.files import camera_to_json, open_camera, read_camera
from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import Source, open_source
from factorsfm.frames.ranges import parse_range
from factorsfm.frames.raw import RawFormat
from factorsfm.priors.depth import DepthPrior, open_depth
from factorsfm.priors.masks import MaskPrior, open_masks
from factorsfm.report.result_folder import check_directory, write_failure, write_folder
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import conclusion, verdict
from factorsfm.streaming.episode import Episode, ShotResult
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.options import Options
from factorsfm.viewer.viewer import Viewer, open_viewer

Progress = Callable[[str, int, int | None], None]
Show = Callable[[str], None]

logger = logging.getLogger(__name__)

_SPEED_FRAMES = 48  # over which the speed is averaged


def add_source(parser: argparse.ArgumentParser) -> None:
    """Declare what is read."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a video file, a folder of images, camera:NUMBER, the URL of a network stream, or - for raw frames on "
        "standard input",
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments that only this command has."""
    parser.add_argument(
        "--raw", metavar="WxH:FORMAT", help="size and pixels of raw frames: bgr24, rgb24, gray8, yuv420p or nv12"
    )
    parser.add_argument("--watch", action="store_true", help="wait for further images in the folder")
    parser.add_argument("--end-file", metavar="FILE", help="a watched folder is complete when this file is in it")
    parser.add_argument(
        "--drop",
        action=argparse.BooleanOptionalAction,
        help="leave frames out where tracking is slower than the source (default: cameras and network streams only)",
    )
    parser.add_argument(
        "--stall-seconds",
        type=_seconds,
        default=10.0,
        metavar="S|none",
        help="end when no frame has come for so long (default: %(default)g)",
    )
    parser.add_argument("--cuts", action="store_true", help="a result for every shot: DIR/shot-001, ...")
    parser.add_argument("--snapshot", type=Path, metavar="FILE", help="save everything here now and then")
    parser.add_argument(
        "--snapshot-every", type=_count, metavar="N", help="frames between two snapshots (default: 100)"
    )
    parser.add_argument("--resume", type=Path, metavar="FILE", help="go on from a snapshot, with the same options")
    parser.add_argument("--viewer", action="store_true", help="watch it in the window of Rerun")
    parser.add_argument("--record", type=Path, metavar="FILE.rrd", help="record it for the viewer")


def run(arguments: argparse.Namespace, progress: Progress, show: Show) -> str:
    """Follow a source to its end, or until Ctrl-C, and write the result.

    Args:
        progress: told the stages after the last frame; show: one line on the state after every frame.

    Returns:
        Sentences for the user.

    Raises:
        InputError: nothing has been written.
        ReconstructionError: the reason has been written.
        KeyboardInterrupt: a second Ctrl-C.
    """
    _check(arguments)
    begin = time.perf_counter()
    camera = open_camera(arguments.camera)
    frames = parse_range(arguments.frames) if arguments.frames is not None else None
    raw = RawFormat.parse(arguments.raw) if arguments.raw else None
    options = replace(Options.preset_named(arguments.preset), lens=arguments.lens, shutter=arguments.shutter)
    depth = open_depth(unless_none(arguments.depth), arguments.depth_kind) if options.uses_depth else None
    masks = open_masks(unless_none(arguments.masks))
    with open_viewer(arguments.viewer, arguments.record) as viewer, ExitStack() as held:
        watched = viewer.watch(depth)
        resumed = held.enter_context(_resumed(arguments, watched, masks)) if arguments.resume else None
        with open_source(
            arguments.source,
            frames=frames,
            raw=raw,
            watch=arguments.watch,
            end_file=arguments.end_file,
            drop=arguments.drop,
            stall_seconds=arguments.stall_seconds,
        ) as source:
            target: Stream | Episode | None = resumed
            end = _End(arguments, source, begin, input_options(depth, masks, frames))
            incoming = _after(source, resumed, arguments.source) if resumed is not None else source
            with _first_interrupt() as interrupt:
                line = _Line(show, source, arguments.cuts)
                for frame in interrupt.until(incoming):
                    if target is None:
                        given: dict[str, Any] = {"depth": watched, "masks": masks, "options": options}
                        target = (
                            Episode(camera, finished=end.write_shot, **given)
                            if arguments.cuts
                            else Stream(camera, **given)
                        )
                        held.callback(target.close)
                    start = time.perf_counter()
                    update = target.push(frame)
                    line.tell(update, time.perf_counter() - start)
                    stream = target.stream if isinstance(target, Episode) else target
                    viewer.log(frame, update, stream)
                    if arguments.snapshot and len(stream.frames) % (arguments.snapshot_every or 100) == 0:
                        _save(stream, arguments.snapshot)
        if target is None:
            raise InputError(f"no frame came from {source.name} before it was interrupted")
        if isinstance(target, Stream) and arguments.snapshot:
            _save(target, arguments.snapshot)
        check_matched(arguments.source, depth, masks)
        if isinstance(target, Episode):
            target.finish(progress)
            return end.conclude()
        return end.write(target, viewer, progress)


def unless_none(text: str | None) -> str | None:
    """The word "none" is no value."""
    return None if text == "none" else text


class _Line:
    """The state in one line."""

    def __init__(self, show: Show, source: Source, shots: bool) -> None:
        self._show, self._source, self._shots = show, source, shots
        self._times = deque([time.monotonic()], maxlen=_SPEED_FRAMES + 1)

    def tell(self, update: FrameUpdate, latency: float) -> None:
        self._times.append(time.monotonic())
        speed = (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-9)
        shot = f"shot {update.shot + 1}, " if self._shots else ""
        dropped = f", {self._source.dropped} dropped" if self._source.dropped else ""
        status = update.status.replace("_", " ")
        self._show(
            f"{shot}frame {update.index}, {speed:.1f} frames/s, latency {1e3 * latency:.0f} ms{dropped}; "
            f"{status}: {update.message}"
        )


class _End:
    """Writes what has come of the frames."""

    def __init__(self, arguments: argparse.Namespace, source: Source, begin: float, inputs: Mapping[str, Any]) -> None:
        self._inputs = inputs
        self._output: Path = arguments.output
        self._source = source
        self._begin = begin
        self._said: list[str] = []  # of the shots of a film
        self._reconstructed = 0  # of these
        self._given = {k: v for k, v in vars(arguments).items() if k not in ("command", "output", "verbose")}
        if "://" in arguments.source:  # it may hold a password
            self._given["source"] = source.name

    def write(self, stream: Stream, viewer: Viewer, progress: Progress) -> str:
        try:
            reconstruction = stream.finish(progress)
        except ReconstructionError as error:
            write_failure(self._output, str(error), error.frames, self._given, self._seconds())
            raise
        viewer.log_result(reconstruction)
        progress("writing", 0, None)
        write_folder(self._completed(reconstruction), self._output)
        return conclusion(reconstruction, self._output)

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


class _Interrupt:
    """The first Ctrl-C ends the frames, never in the middle of one; a second one ends everything."""

    def __init__(self) -> None:
        self._asked = False
        self._waiting = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._asked = True
        if self._waiting:
            raise KeyboardInterrupt

    def until(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """The frames that come before the interrupt."""
        while not self._asked:
            try:
                self._waiting = True
                frame = next(frames, None)
                self._waiting = False
            except KeyboardInterrupt:
                return
            if frame is None:
                return
            yield frame


@contextmanager
def _first_interrupt() -> Iterator[_Interrupt]:
    interrupt = _Interrupt()
    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)


def _check(arguments: argparse.Namespace) -> None:
    """What contradicts itself, before anything is opened."""
    if arguments.snapshot_every and not arguments.snapshot:
        raise InputError("--snapshot-every needs --snapshot FILE")
    if arguments.cuts and (arguments.snapshot or arguments.resume):
        raise InputError("--cuts cannot be combined with --snapshot or --resume")
    if arguments.snapshot and not arguments.snapshot.absolute().parent.is_dir():
        raise InputError(f"snapshot {arguments.snapshot} cannot be written: its folder does not exist")
    check_directory(arguments.output)
    if arguments.cuts and arguments.output.is_dir() and any(arguments.output.iterdir()):
        raise InputError(f"the output folder {arguments.output} is not empty; --cuts needs a new or empty one")


def _resumed(arguments: argparse.Namespace, depth: DepthPrior | None, masks: MaskPrior | None) -> Stream:
    with ExitStack() as unless_the_same:
        stream = unless_the_same.enter_context(Stream.load(arguments.resume, depth=depth, masks=masks))
        if stream.options.preset != arguments.preset:
            raise InputError(
                f"snapshot {arguments.resume} was made with --preset {stream.options.preset}, not {arguments.preset}"
            )
        if arguments.camera:
            given = camera_to_json(read_camera(arguments.camera))
            if stream.camera is not None and given != camera_to_json(stream.camera):
                raise InputError(f"snapshot {arguments.resume} was made with another camera than {arguments.camera}")
        unless_the_same.pop_all()
        return stream


def _after(source: Source, stream: Stream, name: str) -> Iterator[Frame]:
    """The frames that the stream does not have yet; those of a live source, counted from 0 again, go on."""
    if not stream.frames:
        yield from source
        return
    last = stream.frames[-1]
    if Path(name).exists():
        yield from (frame for frame in source if frame.index > last.index)
        return
    for frame in source:
        index = last.index + 1 + frame.index
        timestamp = None if frame.timestamp is None else frame.timestamp + (last.timestamp or 0.0)
        yield replace(frame, index=index, name=f"{index:06d}", timestamp=timestamp)


def _save(stream: Stream, path: Path) -> None:
    """What cannot be saved, now that the stream runs, must not end it."""
    try:
        stream.save(path)
    except InputError as error:
        logger.warning(error)


def _seconds(text: str) -> float | None:
    if text == "none":
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f'"{text}" is neither a positive number of seconds nor none')
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'"{text}" is no number of frames')
    return int(text)
