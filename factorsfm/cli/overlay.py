"""``factorsfm overlay``: the footage with objects that are locked into the scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from factorsfm.cli.command import Command, add_shot
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.report.overlay import CODECS, LAYERS, write_overlay
from factorsfm.result.reading import read_result

_PLANES = {
    "ground": "the ground that {n} points lie on",
    "plane": "the plane that {n} points lie on",
    "distance": "a plane at the median distance, since too few points lie on one",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help=f"the video to write ({', '.join(CODECS)})"
    )
    add_shot(parser, "--source")
    parser.add_argument("--hide", nargs="+", choices=LAYERS, default=[], help="what not to draw")


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the overlay; see `Command.run`."""
    reconstruction = read_result(arguments.result)
    props = write_overlay(reconstruction, arguments.output, arguments.footage, hide=arguments.hide, progress=progress)
    plane = _PLANES[props.plane.kind].format(n=len(props.plane.support))
    return f"Wrote {arguments.output}: the grid is on {plane}; a cell is {props.cell:g} wide."


COMMAND = Command(
    "overlay",
    help="write the footage with points, a grid and cubes locked into the scene",
    description="Write the footage as a video with points, a grid and cubes locked into the scene.",
    add_arguments=add_arguments,
    run=run,
)
