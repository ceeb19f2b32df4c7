"""``factorsfm stream``: a shot while it arrives."""

from __future__ import annotations

import argparse
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from factorsfm.camera.files import camera_to_json, open_camera
from factorsfm.cli.command import (
    Command,
    add_footage,
    add_imu,
    add_method,
    add_output,
    add_range,
    count_of,
    range_of,
    unless_none,
)
from factorsfm.cli.interrupt import first_interrupt
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.cli.stream_results import StreamResults
from factorsfm.export.writing import entries_of
from factorsfm.frames.frame import Frame
from factorsfm.frames.live_sources import Source, open_source
from factorsfm.frames.raw import RawFormat
from factorsfm.frames.targets import spare_footage
from factorsfm.inertial.mounting import open_imu
from factorsfm.inertial.recording import ImuRecording
from factorsfm.inputs import check_matched, input_options
from factorsfm.priors.depth import DepthPrior, open_depth
from factorsfm.priors.masks import MaskPrior, open_masks
from factorsfm.report.result_folder import check_directory
from factorsfm.streaming.episode import Episode
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import InputError
from factorsfm.support.options import Options
from factorsfm.viewer.viewer import open_viewer

logger = logging.getLogger(__name__)

_SNAPSHOT_EVERY = 100  # frames
_SPEED_FRAMES = 48  # for the mean speed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a video file, a folder of images, camera:NUMBER, the URL of a network stream, or - for raw frames on "
        "standard input",
    )
    add_output(parser)
    add_method(parser)
    add_range(parser)
    add_footage(parser)
    add_imu(parser)
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
        "--snapshot-every", type=count_of("frames"), metavar="N", help="frames between two snapshots (default: 100)"
    )
    parser.add_argument("--resume", type=Path, metavar="FILE", help="go on from a snapshot, with the same options")
    parser.add_argument("--viewer", action="store_true", help="watch it in the window of Rerun")
    parser.add_argument("--record", type=Path, metavar="FILE.rrd", help="record it for the viewer")


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Follow a source to its end, or until Ctrl-C, and write the result; see `Command.run`.

    Raises:
        KeyboardInterrupt: a second Ctrl-C.
    """
    _check(arguments)
    begin = time.perf_counter()
    given = _open_inputs(arguments)
    with open_viewer(arguments.viewer, arguments.record) as viewer, ExitStack() as held:
        shown = replace(given, depth=viewer.watch(given.depth))
        resumed = held.enter_context(_resumed(arguments, shown)) if arguments.resume else None
        target: Stream | Episode | None = resumed
        with _open_source(arguments, given) as source:
            results = StreamResults(arguments, source, begin, _said(arguments, given))
            line = _Line(progress.show, source, arguments.cuts)
            with first_interrupt() as interrupt:
                for frame in interrupt.until(_after(source, resumed, arguments.source)):
                    if target is None:
                        target = _begin(shown, results, cuts=arguments.cuts)
                        held.callback(target.close)
                    update = line.timed(target, frame)
                    stream = target.stream if isinstance(target, Episode) else target
                    viewer.log(frame, update, stream)
                    if arguments.snapshot and len(stream.frames) % (arguments.snapshot_every or _SNAPSHOT_EVERY) == 0:
                        _save(stream, arguments.snapshot)
        if target is None:
            raise InputError(f"no frame came from {source.name} before it was interrupted")
        if isinstance(target, Stream) and arguments.snapshot:
            _save(target, arguments.snapshot)
        check_matched(arguments.source, given.depth, given.masks)
        if isinstance(target, Episode):
            target.finish(progress)
            return results.conclude()
        return results.write(target, viewer, progress)


# --- what is opened before the first frame ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Inputs:
    """The arguments of a stream, opened."""

    camera: pycolmap.Camera | None
    depth: DepthPrior | None
    masks: MaskPrior | None
    imu: ImuRecording | None
    options: Options
    frames: slice | None
    raw: RawFormat | None


def _open_inputs(arguments: argparse.Namespace) -> _Inputs:
    options = replace(Options.preset_named(arguments.preset), lens=arguments.lens, shutter=arguments.shutter)
    return _Inputs(
        camera=open_camera(arguments.camera),
        frames=range_of(arguments),
        raw=RawFormat.parse(arguments.raw) if arguments.raw else None,
        depth=open_depth(unless_none(arguments.depth), arguments.depth_kind) if options.uses_depth else None,
        masks=open_masks(unless_none(arguments.masks)),
        imu=open_imu(arguments.imu) if arguments.imu else None,
        options=options,
    )


def _said(arguments: argparse.Namespace, given: _Inputs) -> dict[str, Any]:
    return input_options(
        arguments.source, given.depth, given.masks, given.frames, arguments.fields, arguments.pixel_aspect
    )


def _open_source(arguments: argparse.Namespace, given: _Inputs) -> Source:
    return open_source(
        arguments.source,
        frames=given.frames,
        fields=arguments.fields,
        pixel_aspect=arguments.pixel_aspect,
        raw=given.raw,
        watch=arguments.watch,
        end_file=arguments.end_file,
        drop=arguments.drop,
        stall_seconds=arguments.stall_seconds,
    )


def _begin(given: _Inputs, results: StreamResults, *, cuts: bool) -> Stream | Episode:
    """A stream, or an episode if the source is cut into shots."""
    if cuts:
        return Episode(
            given.camera,
            depth=given.depth,
            masks=given.masks,
            options=given.options,
            finished=results.write_shot,
        )
    return Stream(given.camera, depth=given.depth, masks=given.masks, options=given.options, imu=given.imu)


class _Line:
    """The line of progress: speed, latency and status."""

    def __init__(self, show: Callable[[str], None], source: Source, shots: bool) -> None:
        self._show, self._source, self._shots = show, source, shots
        self._times = deque([time.monotonic()], maxlen=_SPEED_FRAMES + 1)

    def timed(self, target: Stream | Episode, frame: Frame) -> FrameUpdate:
        """Push a frame, and show the line."""
        begin = time.monotonic()
        update = target.push(frame)
        self._times.append(time.monotonic())
        latency = self._times[-1] - begin
        speed = (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-9)
        shot = f"shot {update.shot + 1}, " if self._shots else ""
        dropped = f", {self._source.dropped} dropped" if self._source.dropped else ""
        status = update.status.replace("_", " ")
        self._show(
            f"{shot}frame {update.index}, {speed:.1f} frames/s, latency {1e3 * latency:.0f} ms{dropped}; "
            f"{status}: {update.message}"
        )
        return update


def _check(arguments: argparse.Namespace) -> None:
    """Check the arguments before anything is opened."""
    if arguments.snapshot_every and not arguments.snapshot:
        raise InputError("--snapshot-every needs --snapshot FILE")
    if arguments.cuts and (arguments.snapshot or arguments.resume):
        raise InputError("--cuts cannot be combined with --snapshot or --resume")
    if arguments.cuts and arguments.imu:
        raise InputError("--cuts cannot be combined with --imu: the recording of an IMU is of one shot")
    if arguments.snapshot and not arguments.snapshot.absolute().parent.is_dir():
        raise InputError(f"snapshot {arguments.snapshot} cannot be written: its folder does not exist")
    check_directory(arguments.output, arguments.source)
    spare_footage([path for path in (arguments.snapshot, arguments.record) if path], arguments.source)
    if arguments.cuts and arguments.output.is_dir() and entries_of(arguments.output):
        raise InputError(f"the output folder {arguments.output} is not empty; --cuts needs a new or empty one")


def _resumed(arguments: argparse.Namespace, given: _Inputs) -> Stream:
    """The stream of a snapshot, which must have the same preset and camera."""
    with ExitStack() as unless_the_same:
        stream = unless_the_same.enter_context(
            Stream.load(arguments.resume, depth=given.depth, masks=given.masks, imu=given.imu)
        )
        if stream.options.preset != arguments.preset:
            raise InputError(
                f"snapshot {arguments.resume} was made with --preset {stream.options.preset}, not {arguments.preset}"
            )
        cameras = [camera_to_json(camera) for camera in (given.camera, stream.camera) if camera is not None]
        if given.camera is not None and cameras[0] != cameras[-1]:
            raise InputError(f"snapshot {arguments.resume} was made with another camera than {arguments.camera}")
        unless_the_same.pop_all()
        return stream


def _after(source: Source, stream: Stream | None, name: str) -> Iterator[Frame]:
    """The frames that a resumed stream does not have yet; a live source starts at 0 and is renumbered."""
    if stream is None or not stream.frames:
        yield from source
        return
    last = stream.newest
    if Path(name).exists():
        yield from (frame for frame in source if frame.index > last.index)
        return
    for frame in source:
        index = last.index + 1 + frame.index
        timestamp = None if frame.timestamp is None else frame.timestamp + (last.timestamp or 0.0)
        yield replace(frame, index=index, name=f"{index:06d}", timestamp=timestamp)


def _save(stream: Stream, path: Path) -> None:
    """Save a snapshot; an error is logged and does not end the stream."""
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


COMMAND = Command(
    "stream",
    help="follow a shot while it arrives: from a camera, a network, a pipe, a folder that fills, or a file",
    description="Give every frame a pose as it arrives; at the end, or at Ctrl-C, polish and write the result.",
    add_arguments=add_arguments,
    run=run,
    followed=True,
)
