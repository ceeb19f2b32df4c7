"""The command line: reads arguments, calls the Python interface, writes the result folder."""

from __future__ import annotations

import argparse
import logging
import shutil
import sys
import time
from collections.abc import Sequence
from logging.handlers import MemoryHandler
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, TextIO, get_args

from factorsfm import api
from factorsfm.camera.files import open_camera
from factorsfm.cli import batch as batch_command
from factorsfm.cli import demo
from factorsfm.cli import export as export_command
from factorsfm.cli import overlay as overlay_command
from factorsfm.cli import stream as stream_command
from factorsfm.cli.stream import unless_none
from factorsfm.frames.ranges import parse_range
from factorsfm.imagesets import add_images as extension
from factorsfm.priors.depth_map import DepthKind
from factorsfm.report.result_folder import check_directory, write_failure, write_folder
from factorsfm.result.summary import conclusion
from factorsfm.support.errors import FactorsfmError, ReconstructionError
from factorsfm.support.json_text import as_text, is_text
from factorsfm.support.options import PRESETS, LensFreedom, ShutterUse
from factorsfm.support.program import program_version

logger = logging.getLogger(__name__)

BAD_INPUT, NOT_RECONSTRUCTED, INTERRUPTED = 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit status: 0 done, 2 bad input, 3 the shot cannot be reconstructed, 130 interrupted.
    """
    parser = _parser()
    given = sys.argv[1:] if argv is None else list(argv)
    if strange := [argument for argument in given if not is_text(argument)]:
        parser.error(f"the argument {strange[0]!r} is not UTF-8")
    arguments = parser.parse_args(given)
    progress = _Progress(sys.stderr, enabled=sys.stderr.isatty() and not arguments.verbose)
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(arguments.verbose, 2)]
    # Bad input is one line for scripts; until it is known, warnings wait, except where somebody follows the run.
    followed = sys.stderr.isatty() or arguments.verbose or arguments.command in ("stream", "batch")
    log = MemoryHandler(1000, logging.DEBUG if followed else logging.CRITICAL, _LogHandler(progress))
    logging.basicConfig(level=level, handlers=[log])
    logging.captureWarnings(True)
    try:
        with progress:
            said = _run(arguments, progress)
            progress.clear()
            print(as_text(said))
    except ReconstructionError as error:
        return _complain(f"error: {error}", NOT_RECONSTRUCTED)
    except FactorsfmError as error:
        log.buffer.clear()
        return _complain(f"error: {error}", BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except (OSError, MemoryError) as error:  # of the machine, not of the program
        logger.debug("", exc_info=True)
        log.buffer.clear()
        return _complain(f"error: {str(error) or 'not enough memory'}", BAD_INPUT)
    finally:
        log.flush()
    return 0


def _run(arguments: argparse.Namespace, progress: _Progress) -> str:
    """Run the command that was asked for; what to say of it."""
    match arguments.command:
        case "demo":
            return _demo(arguments, progress)
        case "extend":
            return _extend(arguments, progress)
        case "export":
            return export_command.run(arguments)
        case "stream":
            return stream_command.run(arguments, progress, progress.show)
        case "batch":
            return batch_command.run(arguments, progress, progress.show)
        case "overlay":
            return overlay_command.run(arguments, progress)
        case _:
            return _reconstruct(arguments, progress)


def _reconstruct(arguments: argparse.Namespace, progress: _Progress) -> str:
    check_directory(arguments.output)
    camera = open_camera(arguments.camera)
    frames = parse_range(arguments.frames) if arguments.frames is not None else None
    start = time.perf_counter()
    try:
        reconstruction = api.reconstruct(
            arguments.source,
            camera=camera,
            depth=unless_none(arguments.depth),
            depth_kind=arguments.depth_kind,
            masks=unless_none(arguments.masks),
            frames=frames,
            preset=arguments.preset,
            lens=arguments.lens,
            shutter=arguments.shutter,
            unordered=arguments.unordered or None,
            features=arguments.features,
            work=arguments.work,
            control=arguments.control,
            progress=progress,
        )
    except ReconstructionError as error:
        given = {k: v for k, v in vars(arguments).items() if k not in ("command", "output", "verbose")}
        seconds = {"total": time.perf_counter() - start}
        write_failure(arguments.output, str(error), error.frames, given, seconds)
        raise
    progress("writing", 0, None)
    write_folder(reconstruction, arguments.output)
    return conclusion(reconstruction, arguments.output)


def _extend(arguments: argparse.Namespace, progress: _Progress) -> str:
    check_directory(arguments.output)
    reconstruction = extension.add_images(
        arguments.result,
        arguments.images,
        source=arguments.source,
        frames=parse_range(arguments.frames) if arguments.frames is not None else None,
        refine=arguments.refine,
        work=arguments.work,
        progress=progress,
    )
    progress("writing", 0, None)
    write_folder(reconstruction, arguments.output)
    return conclusion(reconstruction, arguments.output)


def _demo(arguments: argparse.Namespace, progress: _Progress) -> str:
    result = demo.run_demo(arguments.output, progress)
    return f"{conclusion(result.reconstruction, arguments.output)}\n{result.comparison()}"


def _complain(message: str, status: int) -> int:
    print(f"factorsfm: {' '.join(message.split())}", file=sys.stderr)
    return status


class _Progress:
    """One line on the terminal, rewritten; nothing where it is not enabled."""

    _SECONDS_BETWEEN = 0.1

    def __init__(self, stream: TextIO, enabled: bool) -> None:
        self._stream = stream
        self._enabled = enabled
        self._stage = ""
        self._written = 0.0
        self._shown = False

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        count = f" {done}/{total}" if total is not None else f" {done}" if done else ""
        self.show(f"{stage}{count}", at_once=stage != self._stage)
        self._stage = stage

    def show(self, text: str, at_once: bool = False) -> None:
        """Replace the line; what comes too soon after another one is left out."""
        now = time.monotonic()
        if not self._enabled or (not at_once and now < self._written + self._SECONDS_BETWEEN):
            return
        self._written, self._shown = now, True
        columns = shutil.get_terminal_size().columns
        self._stream.write(f"\r\x1b[K{text[: columns - 1]}")
        self._stream.flush()

    def clear(self) -> None:
        if self._shown:
            self._stage, self._shown = "", False
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.clear()


class _LogHandler(logging.StreamHandler[TextIO]):
    """Log lines on stderr, in place of the line of progress."""

    def __init__(self, progress: _Progress) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        self._progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        self._progress.clear()
        super().emit(record)


class _Parser(argparse.ArgumentParser):
    """Complains in one line, like every other error of the command line."""

    def error(self, message: str) -> NoReturn:
        sys.exit(_complain(f"error: {message} (see {self.prog} --help)", BAD_INPUT))


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="factorsfm",
        description="Depth-guided structure from motion for shots with little parallax.",
        epilog="Exit status: 0 done, 2 bad input, 3 the shot cannot be reconstructed, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"factorsfm {program_version()}")
    verbose: dict[str, Any] = {"action": "count", "help": "log what happens; twice: in every detail"}
    parser.add_argument("-v", "--verbose", default=0, **verbose)
    common = _Parser(add_help=False)  # without a default: it would overwrite what stands before the command
    common.add_argument("-v", "--verbose", default=argparse.SUPPRESS, **verbose)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    reconstruct = commands.add_parser(
        "reconstruct",
        parents=[common],
        help="recover camera path, lens and points of a shot",
        description="Recover camera path, lens and sparse points of a shot.",
    )
    reconstruct.add_argument("source", metavar="SOURCE", help="a video file, or a folder of images")
    _add_shot_arguments(reconstruct)
    _add_range(reconstruct)
    reconstruct.add_argument(
        "--unordered",
        action="store_true",
        help="match the images of a folder with each other, in any order; by itself where they are hardly a shot",
    )
    reconstruct.add_argument(
        "--features",
        default="sift",
        metavar="sift|xfeat|FOLDER",
        help="keypoints of an unordered set; for xfeat the folder of its networks is named here or in FACTORSFM_MODELS "
        "(default: %(default)s)",
    )
    reconstruct.add_argument(
        "--control",
        type=Path,
        metavar="FILE.json",
        help="known poses, points, distances and heights: the result is in their world and unit",
    )
    reconstruct.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="keep features and matches of an unordered set here: an interrupted run goes on from them",
    )

    stream = commands.add_parser(
        "stream",
        parents=[common],
        help="follow a shot while it arrives: from a camera, a network, a pipe, a folder that fills, or a file",
        description="Give every frame a pose as it arrives; at the end, or at Ctrl-C, polish and write the result.",
    )
    stream_command.add_source(stream)
    _add_shot_arguments(stream)
    _add_range(stream)
    stream_command.add_arguments(stream)

    batch = commands.add_parser(
        "batch",
        parents=[common],
        help="reconstruct every shot of a film, or of a folder of films",
        description="Find the shots of a film, or of all films in a folder, and reconstruct each; goes on where it was "
        "interrupted.",
    )
    batch.add_argument("source", metavar="SOURCE", help="a video file, or a folder of video files")
    _add_shot_arguments(batch, output="folder of the results: new, empty, or that of an earlier run, which goes on")
    batch_command.add_arguments(batch)

    extend = commands.add_parser(
        "extend",
        parents=[common],
        help="add images to a result, in its coordinates",
        description="Register further images of the same lens on a result, whose cameras stay where they are.",
    )
    extend.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    extend.add_argument("images", metavar="IMAGES", help="the images to add: a folder, or a video file")
    extend.add_argument("--output", type=Path, required=True, metavar="DIR", help=_RESULT)
    extend.add_argument(
        "--source", type=Path, metavar="VIDEO|FOLDER", help="the images of the result (default: where they were)"
    )
    extend.add_argument("--refine", action="store_true", help="adjust the known cameras, too")
    _add_range(extend)
    extend.add_argument(
        "--work", type=Path, metavar="DIR", help="keep features and matches here: an interrupted run goes on from them"
    )

    demo_command = commands.add_parser(
        "demo",
        parents=[common],
        help="reconstruct a rendered shot and compare it with the truth",
        description="Render a small shot, reconstruct it from its video file, and compare with the truth.",
    )
    demo_command.add_argument(
        "--output",
        type=Path,
        default=Path("factorsfm_demo"),
        metavar="DIR",
        help="folder of the result (default: %(default)s)",
    )

    export_parser = commands.add_parser(
        "export",
        parents=[common],
        help="write a result for another tool: Nuke, Blender, USD and others",
        description="Write a result for another tool.",
    )
    export_command.add_arguments(export_parser)

    overlay_parser = commands.add_parser(
        "overlay",
        parents=[common],
        help="write the footage with points, a grid and cubes locked into the scene",
        description="Write the footage as a video with points, a grid and cubes locked into the scene.",
    )
    overlay_command.add_arguments(overlay_parser)
    return parser


_RESULT = "folder of the result: new, empty, or holding an earlier result, which is replaced"


def _add_shot_arguments(parser: argparse.ArgumentParser, output: str = _RESULT) -> None:
    """What a shot is reconstructed with, and where the result goes."""
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help=output)
    parser.add_argument(
        "--camera", type=Path, metavar="FILE.json", help="width, height, fx, fy, cx, cy; default: estimated"
    )
    parser.add_argument(
        "--depth",
        default="tcmonodepth",
        metavar="MODEL.onnx|NAME|FOLDER|none",
        help="depth prior: a network, a named model, or a folder of maps (default: %(default)s)",
    )
    parser.add_argument(
        "--depth-kind",
        choices=[kind.value for kind in DepthKind],
        help="what the depth prior holds, where it cannot be known",
    )
    parser.add_argument(
        "--masks",
        metavar="FOLDER|MODEL.onnx|none",
        help="what moves and is to be ignored: non-zero in the masks (default: none)",
    )
    parser.add_argument(
        "--lens",
        choices=get_args(LensFreedom),
        default="auto",
        help="what of the lens is estimated where the shot determines it: nothing, the focal length, also the radial "
        "distortion, or also the principal point; radial: the distortion alone; zoom: distortion, and a focal length "
        "for every frame; auto: fixed with --camera, distortion without",
    )
    parser.add_argument(
        "--shutter",
        choices=get_args(ShutterUse),
        default="auto",
        help="what is done with a rolling shutter that the video shows. auto: lens and points are free of it, poses "
        "fit the recorded images; rolling: poses are those of the moment at which the middle of the image is read; "
        "global: it is not looked for",
    )
    parser.add_argument("--preset", choices=list(PRESETS), default="default", help="default: %(default)s")


def _add_range(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", metavar="START:STOP[:STEP]", help="counted from 0, without STOP")
