"""``factorsfm solve``: a result solved again, without what is wrong in it."""

from __future__ import annotations

import argparse
from pathlib import Path

from factorsfm.cli.command import (
    Command,
    add_output,
    add_range,
    add_tracks,
    as_given,
    failure_kept,
    range_of,
    tracks_of,
    write_result,
)
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.mending.solve_again import read_with_pictures, solve_again
from factorsfm.report.result_folder import check_directory
from factorsfm.support.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    add_output(parser)
    parser.add_argument(
        "--without-tracks",
        nargs="+",
        default=[],
        metavar="TRACK",
        help="tracks to leave out, by their numbers or names; the report copies this option for those that are chosen",
    )
    parser.add_argument(
        "--mask-region",
        action="append",
        default=[],
        metavar="[START:STOP:]X,Y,W,H",
        help="a rectangle of the image, in some frames or in all, in which nothing counts; may be given again",
    )
    add_range(parser)
    parser.add_argument(
        "--control",
        type=Path,
        metavar="FILE.json",
        help="known poses, points, distances and heights (default: those of the result)",
    )
    add_tracks(parser)


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the result that is solved again, or the reason of the failure; see `Command.run`."""
    check_directory(arguments.output)
    if arguments.output.resolve() == arguments.result.resolve():
        raise InputError("the output folder is that of the result, which keeps what is left out; choose another one")
    known = read_with_pictures(arguments.result)
    tracks = tracks_of(arguments, known.options.get("first_number"))
    with failure_kept(arguments.output, {"source": known.options.get("source")} | as_given(arguments)):
        solved = solve_again(
            known,
            without_tracks=arguments.without_tracks,
            mask_regions=arguments.mask_region,
            frames=range_of(arguments),
            control=arguments.control,
            tracks=tracks,
            progress=progress,
        )
    return write_result(solved, arguments.output, progress)


COMMAND = Command(
    "solve",
    help="solve a result again, without what is wrong in it",
    description="Solve the shot of a result again, in seconds, from the tracks that the result keeps.",
    add_arguments=add_arguments,
    run=run,
)
