"""The parts of a command, and the arguments that several commands share."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from factorsfm.cli.progress_line import ProgressLine
from factorsfm.frames.fields import Fields
from factorsfm.frames.ranges import parse_range
from factorsfm.mending.user_tracks import DEFAULT_SIGMA_PX, Plate, UserTracks, read_tracks
from factorsfm.priors.depth_map import DepthKind
from factorsfm.report.result_folder import write_failure, write_folder
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import conclusion
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.options import PRESETS, LensFreedom, ShutterUse
from factorsfm.support.progress import Progress

RESULT_FOLDER = "folder of the result: new, empty, or holding an earlier result, which is replaced"


@dataclass(frozen=True, slots=True)
class Command:
    """A command.

    Attributes:
        help: for the list of commands; description: for the command's own help.
        add_arguments: declares the arguments.
        run: runs the command and returns sentences for the user. Raises InputError if the input cannot be used, and
            ReconstructionError if the shot cannot be reconstructed.
        followed: whether warnings are printed at once, because the user watches the command.
    """

    name: str
    help: str
    description: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, ProgressLine], str]
    followed: bool = False


def add_output(parser: argparse.ArgumentParser, help_: str = RESULT_FOLDER) -> None:
    """Declare the output folder."""
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help=help_)


def add_method(parser: argparse.ArgumentParser) -> None:
    """Declare lens, prior, masks and preset."""
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="the lens: JSON with width, height, fx, fy, cx, cy, or a file of OpenCV, COLMAP or OpenTrackIO; default: "
        "estimated",
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
        metavar="FOLDER|people|movable|MODEL.onnx|none",
        help="what moves: a folder of masks, in which non-zero is ignored; or what a network sees, whose tracks count "
        "only if they agree with the rest: people (with animals), or movable (with vehicles, too) (default: none)",
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


def add_objects(parser: argparse.ArgumentParser) -> None:
    """Declare the masks of objects."""
    parser.add_argument(
        "--objects",
        metavar="FOLDER|auto|none",
        help="masks of rigid things that move by themselves, a subfolder for each or numbers in the masks: their "
        "motion is solved, too; auto: things that move beside the scene are found (default: none)",
    )


def add_range(parser: argparse.ArgumentParser) -> None:
    """Declare the range of frames."""
    parser.add_argument(
        "--frames",
        metavar="START:STOP[:STEP]",
        help="counted from 0, or by the numbers in the file names of a sequence; without STOP",
    )


def add_footage(parser: argparse.ArgumentParser) -> None:
    """Declare how video is read."""
    parser.add_argument(
        "--fields",
        choices=get_args(Fields),
        default="auto",
        help="interlaced video. auto: its fields are taken apart into twice the frames of half the lines; apart: those "
        "of any video; blend: frames stay whole, their fields blended",
    )
    parser.add_argument(
        "--pixel-aspect",
        type=float,
        metavar="RATIO",
        help="width of a pixel over its height, 2 for anamorphic lenses (default: as the file says, else 1)",
    )


def add_shot(parser: argparse.ArgumentParser, *other_names: str) -> None:
    """Declare where the shot of a finished result is, under `--footage` and other names."""
    parser.add_argument(
        "--footage",
        *other_names,
        dest="footage",
        type=Path,
        metavar="VIDEO|FOLDER",
        help="the shot, of any size with the same aspect ratio (default: the source)",
    )


def add_align(parser: argparse.ArgumentParser) -> None:
    """Declare whether results are aligned."""
    parser.add_argument(
        "--align", action="store_true", help="the result stands on its ground, as factorsfm align makes it"
    )


def add_imu(parser: argparse.ArgumentParser) -> None:
    """Declare the recording of an IMU."""
    parser.add_argument(
        "--imu",
        type=Path,
        metavar="FILE",
        help="recording of an IMU on the camera (CSV, .gcsv, or a JSON file that names one): the result is metric",
    )


def add_tracks(parser: argparse.ArgumentParser) -> None:
    """Declare tracks of the user."""
    parser.add_argument(
        "--tracks",
        type=Path,
        metavar="FILE",
        help="2-D tracks placed by hand or by another program, which take part with a weight of their own: a table "
        "with track, frame, x and y, a Nuke script with Tracker4 nodes, CameraTracker's or 3DEqualizer's text, After "
        "Effects' keyframes, or a .blend file with a tracked movie clip",
    )
    parser.add_argument(
        "--tracks-sigma",
        type=float,
        metavar="PIXELS",
        help=f"standard deviation of their places (default: {DEFAULT_SIGMA_PX})",
    )
    parser.add_argument(
        "--tracks-on",
        choices=get_args(Plate),
        help="the plate on which they lie (default: as export writes them: undistorted for Nuke, else footage)",
    )
    parser.add_argument(
        "--tracks-first-frame",
        type=int,
        metavar="NUMBER",
        help="number of the source's first frame in their file (default: as export numbers frames)",
    )


def tracks_of(arguments: argparse.Namespace, first_number: int | None) -> UserTracks | None:
    """The tracks of the user; `first_number`: of a source that is a numbered sequence.

    Raises:
        InputError: they cannot be read, or something is said of them and they are not given.
    """
    if arguments.tracks is None:
        said = [name for name in ("sigma", "on", "first_frame") if getattr(arguments, f"tracks_{name}") is not None]
        if said:
            raise InputError(f"--tracks-{said[0].replace('_', '-')} needs --tracks FILE")
        return None
    return read_tracks(
        arguments.tracks,
        first_number=first_number,
        first_frame=arguments.tracks_first_frame,
        sigma=DEFAULT_SIGMA_PX if arguments.tracks_sigma is None else arguments.tracks_sigma,
        on=arguments.tracks_on,
    )


def range_of(arguments: argparse.Namespace) -> slice | None:
    """The range of frames, None for all.

    Raises:
        InputError: it is not a range.
    """
    return parse_range(arguments.frames) if arguments.frames is not None else None


def unless_none(text: str | None) -> str | None:
    """None for the word "none", else the text."""
    return None if text == "none" else text


def as_given(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments as options of a failed result."""
    return {name: value for name, value in vars(arguments).items() if name not in ("command", "output", "verbose")}


@contextmanager
def failure_kept(output: Path, options: Mapping[str, Any]) -> Iterator[None]:
    """Write the reason, with options, into the output folder where a shot cannot be reconstructed in the block."""
    begin = time.perf_counter()
    try:
        yield
    except ReconstructionError as error:
        write_failure(output, str(error), error.frames, options, {"total": time.perf_counter() - begin})
        raise


def write_result(reconstruction: Reconstruction, output: Path, progress: Progress) -> str:
    """Write the result folder, and return the sentences for the user."""
    progress("writing", 0, None)
    write_folder(reconstruction, output)
    return conclusion(reconstruction, output)


def count_of(what: str) -> Callable[[str], int]:
    """The argparse type of a number from 1; the message names what is counted."""

    def count(text: str) -> int:
        if not re.fullmatch(r"0*[1-9]\d{0,8}", text, re.ASCII):
            raise argparse.ArgumentTypeError(f'"{text}" is no number of {what}')
        return int(text)

    return count
