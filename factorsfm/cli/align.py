"""``factorsfm align``: a result that stands on its ground."""

from __future__ import annotations

import argparse
from pathlib import Path

from factorsfm.alignment.align import Length, align
from factorsfm.cli.command import RESULT_FOLDER, Command, add_shot, write_result
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.report.result_folder import check_directory
from factorsfm.report.thumbnails import retake
from factorsfm.result.reading import read_result
from factorsfm.support.errors import InputError

_PICK = "FRAME:X,Y|NAME"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    parser.add_argument("--output", type=Path, metavar="DIR", help=f"{RESULT_FOLDER} (default: RESULT itself)")
    parser.add_argument(
        "--origin", metavar=_PICK, help="pixel, or name of a track, of the point that becomes the origin"
    )
    parser.add_argument("--axis", metavar=_PICK, help="pixel or name of a point in the direction of the x axis")
    parser.add_argument(
        "--plane", metavar=_PICK, help="pixel or name of a third point; origin, axis and this one lie on the ground"
    )
    parser.add_argument(
        "--distance",
        nargs=3,
        metavar=(_PICK, _PICK, "METRES[,SIGMA]"),
        help="a known distance between two picked points",
    )
    parser.add_argument(
        "--camera-height", type=float, metavar="METRES", help="known height of the first camera above the ground"
    )
    add_shot(parser)


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the aligned result; see `Command.run`."""
    output = arguments.output or arguments.result
    check_directory(output, arguments.footage)
    progress("aligning", 0, None)
    aligned = align(
        read_result(arguments.result),
        origin=arguments.origin,
        axis=arguments.axis,
        plane=arguments.plane,
        distance=None if arguments.distance is None else _length(*arguments.distance),
        camera_height=arguments.camera_height,
        footage=arguments.footage,
    )
    retake(aligned, arguments.footage)
    return write_result(aligned, output, progress)


def _length(a: str, b: str, text: str) -> Length:
    metres, _, sigma = text.partition(",")
    try:
        return Length(a, b, float(metres), float(sigma or 0.0))
    except ValueError:
        raise InputError(f'"{text}" is no length; METRES or METRES,SIGMA is expected, such as 2.4,0.01') from None


COMMAND = Command(
    "align",
    help="give a result its ground, origin and unit",
    description="Align the world of a result: level, on its ground, with an origin and a unit.",
    add_arguments=add_arguments,
    run=run,
)
