"""``factorsfm demo``: render a shot, reconstruct it from its video file, compare with the truth."""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorsfm import api
from factorsfm.camera.files import read_camera
from factorsfm.cli.command import Command
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.evaluation.metrics import TrajectoryErrors, trajectory_errors
from factorsfm.export.writing import complete_file
from factorsfm.frames.writing import write_image
from factorsfm.report.picture import draw_picture
from factorsfm.report.result_folder import check_directory, write_folder
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import conclusion
from factorsfm.support.progress import Progress
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_shot, write_shot


@dataclass(frozen=True, slots=True)
class DemoResult:
    """A reconstruction compared with the truth.

    Attributes:
        reconstruction: of the rendered shot.
        errors: of its camera path after similarity alignment, units of the truth and degrees.
        path_length: of the true camera path, units of the truth.
    """

    reconstruction: Reconstruction
    errors: TrajectoryErrors
    path_length: float

    def comparison(self) -> str:
        """The errors in words."""
        position, step = (100 * float(np.median(e)) / self.path_length for e in (self.errors.ate, self.errors.t_rpe))
        return (
            "Against the truth, after similarity alignment (medians): "
            f"camera position {position:.2f} % of the path's length; "
            f"from frame to frame {step:.2f} % and {float(np.median(self.errors.r_rpe)):.4f} degrees."
        )


def run_demo(directory: str | Path, progress: Progress | None = None) -> DemoResult:
    """Render, reconstruct and compare; write the result folder, with a picture.png.

    Args:
        directory: of the result: new, empty, or with an earlier result, which is replaced.

    Raises:
        InputError: the directory cannot be written.
        ReconstructionError: the shot cannot be reconstructed.
    """
    check_directory(directory)
    if progress is not None:
        progress("rendering", 0, None)
    shot = render_shot()
    with tempfile.TemporaryDirectory(prefix="factorsfm-demo-") as temporary:
        folder = Path(temporary)
        write_shot(shot, folder)
        reconstruction = api.reconstruct(
            folder / "shot.mp4",
            camera=read_camera(folder / "camera.json"),
            depth=folder / "depth",
            depth_kind="inverse",
            progress=progress,
        )
    truth = pose_arrays(shot.cam_from_world)
    estimate = pose_arrays([frame.cam_from_world for frame in reconstruction.frames])
    errors = trajectory_errors(*estimate, *truth)
    path_length = float(np.linalg.norm(np.diff(truth[1], axis=0), axis=1).sum())
    reconstruction.options["source"] = "rendered shot"  # the file was temporary
    write_folder(reconstruction, directory)
    with complete_file(Path(directory) / "picture.png") as file:
        write_image(file, draw_picture(reconstruction))
    return DemoResult(reconstruction, errors, path_length)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("factorsfm_demo"),
        metavar="DIR",
        help="folder of the result (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Write the result and compare it with the truth; see `Command.run`."""
    result = run_demo(arguments.output, progress)
    return f"{conclusion(result.reconstruction, arguments.output)}\n{result.comparison()}"


COMMAND = Command(
    "demo",
    help="reconstruct a rendered shot and compare it with the truth",
    description="Render a small shot, reconstruct it from its video file, and compare with the truth.",
    add_arguments=add_arguments,
    run=run,
)
