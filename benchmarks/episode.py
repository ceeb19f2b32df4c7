"""A film of six shots, reconstructed by `factorsfm batch`: ``python -m benchmarks.episode --data FOLDER``."""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import NETWORK_FILES, open_shot
from benchmarks.markdown import table
from benchmarks.plan import FULL
from benchmarks.run import HERE, machine
from benchmarks.usage import cpu_seconds
from factorsfm import InputError, find_shots, read_result, reconstruct
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.evaluation.truth import Shot
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.similarity import pose_arrays
from factorsfm.support.threads import available_cores

Image = NDArray[np.uint8]

SHOTS = (
    "d01_livingroom_dolly_in",
    "d04_warehouse_crane",
    "d06_keep_static_breath",
    "d02_livingroom_truck_actor",
    "d07_keep_pan_trans_actor",
    "d08_arena_pedestal",
)
_FADE_FRAMES = 10  # of a fade out, and of a fade in
_BLACK_FRAMES = 5  # between them
_FRAMES_PER_SECOND = 24


@dataclass(frozen=True, slots=True)
class Part:
    """A shot in the film.

    Attributes:
        frames: the frames of the film that are its own.
        before, after: number of frames of a fade that show its first or last image; 0 at a cut.
    """

    shot: Shot
    frames: range
    before: int
    after: int

    @property
    def middle(self) -> int:
        """Its middle frame in the film."""
        return self.frames[len(self.frames) // 2]

    def is_found(self, found: range) -> bool:
        """Whether a range of frames has its boundaries: at a cut exactly, at a fade anywhere in it."""
        early, late = self.frames.start - found.start, found.stop - self.frames.stop
        return 0 <= early <= self.before and 0 <= late <= self.after


def write_film(shots: Sequence[Shot], limit: int | None, folder: Path) -> list[Part]:
    """Write the shots to ``film.avi``, coded without loss, and their masks; after every second shot there is a fade.

    Args:
        limit: most frames of a shot; None for all.
    """
    (folder / "masks").mkdir()
    video: cv2.VideoWriter | None = None
    parts = []
    written = 0
    for number, shot in enumerate(shots):
        images = [frame.image for frame in islice(shot.frames(), limit)]
        before = _FADE_FRAMES if number and number % 2 == 0 else 0
        after = _FADE_FRAMES if number % 2 and number + 1 < len(shots) else 0
        start = written + before
        parts.append(Part(shot, range(start, start + len(images)), before, after))
        for image in _with_fades(images, before, after):
            if video is None:
                size = image.shape[1], image.shape[0]
                codec = cv2.VideoWriter.fourcc(*"FFV1")
                video = cv2.VideoWriter(str(folder / "film.avi"), codec, _FRAMES_PER_SECOND, size)
            video.write(image)
            written += 1
        if shot.masks is not None:
            for k, path in enumerate(sorted(shot.masks.iterdir())[: len(images)]):
                (folder / "masks" / f"{start + k:06d}{path.suffix}").write_bytes(path.read_bytes())
    assert video is not None
    video.release()
    return parts


def _with_fades(images: Sequence[Image], before: int, after: int) -> Iterator[Image]:
    for k in range(before):
        yield _dimmed(images[0], (k + 1) / (before + 1))
    yield from images
    for k in range(after):
        yield _dimmed(images[-1], 1.0 - (k + 1) / (after + 1))
    if after:
        yield from [np.zeros_like(images[-1])] * _BLACK_FRAMES


def _dimmed(image: Image, light: float) -> Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=light), np.uint8)


@dataclass(frozen=True, slots=True)
class Batch:
    """A run of the command.

    Attributes:
        workers: number of processes.
        cores: number of cores that they may use.
        wall, computing: wall time and CPU time, seconds.
    """

    workers: int
    cores: int
    wall: float
    computing: float


def run_batch(folder: Path, output: str, network: Path, workers: int, cores: Sequence[int]) -> Batch:
    """Run the command on these cores, with its results in a subfolder `output`."""
    command = [sys.executable, "-m", "factorsfm", "batch", str(folder / "film.avi"), "--output", str(folder / output)]
    command += ["--depth", str(network), "--workers", str(workers)]
    if any((folder / "masks").iterdir()):
        command += ["--masks", str(folder / "masks")]
    begin, before = time.perf_counter(), cpu_seconds()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, preexec_fn=partial(os.sched_setaffinity, 0, cores))
    return Batch(workers, len(cores), time.perf_counter() - begin, cpu_seconds() - before)


def median_ate(reconstruction: Reconstruction, shot: Shot, frames: range) -> float:
    """Median ATE, metres, over a range of frames of the reconstruction that begins with the first frame of the shot."""
    own = [frame for frame in reconstruction.frames if frame.index in frames]
    truth = shot.truth(np.array([frame.index - frames.start for frame in own]))
    errors = trajectory_errors(*pose_arrays([frame.cam_from_world for frame in own]), *truth)
    return float(np.median(errors.ate))


def measure(shots: Sequence[Shot], limit: int | None, network: Path, folder: Path) -> list[str]:
    """Reconstruct the film in three ways and each shot by itself; returns the sections of the page."""
    parts = write_film(shots, limit, folder)
    found = find_shots(folder / "film.avi")
    right = len(found) == len(parts) and all(part.is_found(f) for part, f in zip(parts, found, strict=True))
    numbers = [next(n for n, f in enumerate(found, 1) if part.middle in f) for part in parts]
    cores = available_cores()
    many = len(cores)
    alone, whole, full = (
        run_batch(folder, f"workers {n} of {len(some)}", network, n, some)
        for n, some in ((1, cores[:1]), (1, cores), (many, cores))
    )
    rows: list[list[object]] = []
    ratios = []
    for number, part in zip(numbers, parts, strict=True):
        single = reconstruct(part.shot.source, depth=network, masks=part.shot.masks, frames=slice(0, len(part.frames)))
        own = median_ate(single, part.shot, range(len(part.frames)))
        ate = [
            _batch_ate(folder / f"workers {b.workers} of {b.cores}" / "film" / f"shot_{number:03d}", part)
            for b in (whole, full)
        ]
        ratios.append(ate[1] / own)
        spans = [f"{span.start} to {span.stop - 1}" for span in (part.frames, found[number - 1])]
        rows.append([part.shot.name, *spans, *(f"{1e3 * value:.2f}" for value in (own, *ate)), f"{ratios[-1]:.2f}"])
    frames, runs = sum(len(part.frames) for part in parts), (alone, whole, full)
    return [
        "## Shots",
        f"Boundaries, {'all' if right else 'NOT all'} correct: exact at cuts, at fades within the {_FADE_FRAMES} "
        "frames that show the first or last image of the shot. Median ATE in mm of a shot that is reconstructed from "
        f"its own file, in the film by one worker, and in the film by {many}. The film is coded without loss, but in "
        "another colour space than the files, and a shot beside a fade has more still frames, so that the numbers "
        "differ.",
        table(
            ["shot", "frames", "found", "own file", "1 worker", f"{many} workers", f"{many} workers / own file"],
            rows,
        ),
        f"Median ratio **{np.median(ratios):.2f}**.",
        "## Throughput",
        table(
            ["workers", "cores", "seconds", "of computing on all cores", "frames per second"],
            [[b.workers, b.cores, f"{b.wall:.1f}", f"{b.computing:.1f}", f"{frames / b.wall:.2f}"] for b in runs],
        ),
        f"{many} workers with a core each, the default of `batch`, are **{alone.wall / full.wall:.2f}** times as fast "
        "as one worker with one core. One worker with all cores already uses most of them, because tracking, graph and "
        f"decoder run in parallel: {many} workers are {whole.wall / full.wall:.2f} times as fast as that one. The "
        "times include the start, the search for cuts, and the last shots, during which workers are idle.",
    ]


def _batch_ate(folder: Path, part: Part) -> float:
    """Median ATE of a shot of the film, metres; NaN if it has no reconstruction."""
    try:
        return median_ate(read_result(folder), part.shot, part.frames)
    except InputError:
        return float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.episode", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--models", type=Path, help="folder of the networks (default: models beside the data)")
    parser.add_argument("--shots", nargs="+", default=SHOTS, metavar="NAME", help="these, in this order")
    parser.add_argument("--frames", type=int, metavar="N", help="only the first frames of each")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of EPISODE.md")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    models = arguments.models or arguments.data.parent / "models"
    shots = [open_shot(arguments.data, name, FULL) for name in arguments.shots]
    with tempfile.TemporaryDirectory(prefix="episode-") as folder:
        measured = measure(shots, arguments.frames, models / NETWORK_FILES["tcmonodepth"], Path(folder))
    words = ["FOLDER" if word == str(arguments.data) else word for word in sys.argv[1:]]
    parts = [
        "# A film",
        f"Generated by `{shlex.join(['python', '-m', 'benchmarks.episode', *words])}`.",
        f"Machine: {machine()}; load at the start {load:.1f}. Rendered shots in one file, TCMonoDepth, unknown lenses, "
        "masks where actors are.",
        *measured,
    ]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "EPISODE.md").write_text("\n\n".join(parts) + "\n")
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
