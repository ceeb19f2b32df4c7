"""``factorsfm export``: files for another tool."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from factorsfm.cli.command import Command, add_shot
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.export.formats import FORMATS, export
from factorsfm.export.how_to_train import how_to_train
from factorsfm.export.options import ExportOptions
from factorsfm.export.trajectory import counts_frames
from factorsfm.frames.timing import are_uneven
from factorsfm.result.reading import read_result
from factorsfm.support.up_axis import UpAxis


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    parser.add_argument("--format", required=True, choices=list(FORMATS), metavar="NAME", help=_formats_help())
    parser.add_argument(
        "--output", type=Path, required=True, metavar="PATH", help="the file, or for some formats the folder, to write"
    )
    parser.add_argument("--fps", type=float, help="frames per second (default: the source's, else 24)")
    parser.add_argument(
        "--first-frame",
        type=int,
        metavar="NUMBER",
        help="number of the source's first frame (default: that in its file name, else the format's)",
    )
    parser.add_argument(
        "--sensor-width", type=float, default=36.0, metavar="MM", help="of the film back (default: %(default)g)"
    )
    parser.add_argument(
        "--up-axis", choices=[axis.value for axis in UpAxis], help="in the first frame (default: the format's)"
    )
    parser.add_argument("--scale", type=float, help="exported length of one unit (default: the format's)")
    add_shot(parser)
    parser.add_argument(
        "--undistorted",
        action="store_true",
        help="for training (colmap, nerfstudio): images without distortion, and pinhole cameras",
    )
    parser.add_argument(
        "--masks",
        metavar="FOLDER|people|movable|MODEL.onnx",
        help="for training: what is ignored besides what moves by itself, as reconstruct takes it",
    )


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the export; see `Command.run`."""
    given = {field.name: getattr(arguments, field.name) for field in fields(ExportOptions)}
    options = ExportOptions(**given)
    reconstruction = read_result(arguments.result)
    export(reconstruction, arguments.output, format=arguments.format, options=options)
    lost = len(reconstruction.frames) - len(reconstruction.registered)
    without = f"; {lost} of {len(reconstruction.frames)} frames are not registered and have no camera" if lost else ""
    times = [frame.timestamp for frame in reconstruction.frames]
    counted = arguments.format != "tum" or counts_frames(options)
    uneven = counted and are_uneven([frame.index for frame in reconstruction.frames], times)
    rate = "; its frames come at uneven times, and here each lasts as long as any other" if uneven else ""
    wrote = f"Wrote {arguments.format} ({FORMATS[arguments.format].description}) to {arguments.output}{without}{rate}."
    if not FORMATS[arguments.format].trains:
        return wrote
    return "\n".join([wrote, *how_to_train(reconstruction, arguments.output, arguments.format, options)])


def _formats_help() -> str:
    return "; ".join(f"{name}: {format.description}" for name, format in FORMATS.items())


COMMAND = Command(
    "export",
    help="write a result for another tool: Nuke, Blender, USD and others",
    description="Write a result for another tool.",
    add_arguments=add_arguments,
    run=run,
)
