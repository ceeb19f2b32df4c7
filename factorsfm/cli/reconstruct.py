"""``factorsfm reconstruct``: a shot, or a set of photographs."""

from __future__ import annotations

import argparse
from pathlib import Path

from factorsfm import api
from factorsfm.alignment.align import align
from factorsfm.camera.files import open_camera
from factorsfm.cli.command import (
    Command,
    add_align,
    add_footage,
    add_imu,
    add_method,
    add_objects,
    add_output,
    add_range,
    add_tracks,
    as_given,
    failure_kept,
    range_of,
    tracks_of,
    unless_none,
    write_result,
)
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.frames.numbering import first_number_of
from factorsfm.report.result_folder import check_directory
from factorsfm.support.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("source", metavar="SOURCE", help="a video file, or a folder of images")
    add_output(parser)
    add_method(parser)
    add_objects(parser)
    add_range(parser)
    add_footage(parser)
    parser.add_argument(
        "--unordered",
        action="store_true",
        help="match the images of a folder with each other, in any order; by itself where they are hardly a shot",
    )
    parser.add_argument(
        "--features",
        default="sift",
        metavar="sift|xfeat|FOLDER",
        help="keypoints of an unordered set; for xfeat the folder of its networks is named here or in FACTORSFM_MODELS "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--control",
        type=Path,
        metavar="FILE",
        help="known poses, points, distances and heights (JSON), or the camera of another program (.chan, USD, "
        "Alembic, .blend, transforms.json, COLMAP's folder): the result is in their world and unit",
    )
    add_align(parser)
    add_tracks(parser)
    add_imu(parser)
    parser.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="keep features and matches of an unordered set here: an interrupted run goes on from them",
    )


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the result, or the reason of the failure; see `Command.run`."""
    check_directory(arguments.output, arguments.source)
    if arguments.align and arguments.control is not None:
        raise InputError("--align and --control are given; a result in the world of its control is not aligned")
    camera, frames = open_camera(arguments.camera), range_of(arguments)
    tracks = tracks_of(arguments, first_number_of(arguments.source))
    with failure_kept(arguments.output, as_given(arguments)):
        reconstruction = api.reconstruct(
            arguments.source,
            camera=camera,
            depth=unless_none(arguments.depth),
            depth_kind=arguments.depth_kind,
            masks=unless_none(arguments.masks),
            objects=unless_none(arguments.objects),
            frames=frames,
            fields=arguments.fields,
            pixel_aspect=arguments.pixel_aspect,
            preset=arguments.preset,
            lens=arguments.lens,
            shutter=arguments.shutter,
            unordered=arguments.unordered or None,
            features=arguments.features,
            work=arguments.work,
            control=arguments.control,
            tracks=tracks,
            imu=arguments.imu,
            progress=progress,
        )
    if arguments.align:
        reconstruction = align(reconstruction)
    return write_result(reconstruction, arguments.output, progress)


COMMAND = Command(
    "reconstruct",
    help="recover camera path, lens and points of a shot",
    description="Recover camera path, lens and sparse points of a shot.",
    add_arguments=add_arguments,
    run=run,
)
