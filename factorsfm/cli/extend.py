"""``factorsfm extend``: further images for a result."""

from __future__ import annotations

import argparse
from pathlib import Path

from factorsfm.cli.command import Command, add_output, add_range, range_of, write_result
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.imagesets.add_images import add_images
from factorsfm.report.result_folder import check_directory
from factorsfm.support.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    parser.add_argument("images", metavar="IMAGES", help="the images to add: a folder, or a video file")
    add_output(parser)
    parser.add_argument(
        "--source", type=Path, metavar="VIDEO|FOLDER", help="the images of the result (default: where they were)"
    )
    parser.add_argument("--refine", action="store_true", help="adjust the known cameras, too")
    add_range(parser)
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="keep features and matches here: an interrupted run goes on from them"
    )


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the result with the further images; see `Command.run`."""
    check_directory(arguments.output, arguments.images, arguments.source)
    if arguments.output.resolve() == arguments.result.resolve() and (arguments.result / "tracks.npz").exists():
        raise InputError(
            "the output folder is that of the result, whose tracks the extended one does not keep; choose another one"
        )
    reconstruction = add_images(
        arguments.result,
        arguments.images,
        source=arguments.source,
        frames=range_of(arguments),
        refine=arguments.refine,
        work=arguments.work,
        progress=progress,
    )
    return write_result(reconstruction, arguments.output, progress)


COMMAND = Command(
    "extend",
    help="add images to a result, in its coordinates",
    description="Register further images of the same lens on a result, whose cameras stay where they are.",
    add_arguments=add_arguments,
    run=run,
)
