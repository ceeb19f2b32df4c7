"""``factorsfm batch``: every shot of a film, or of a folder of films."""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

from factorsfm.batch.crew import Crew, open_crew
from factorsfm.batch.index import Entry, Index, shots_known
from factorsfm.batch.plan import Job, Method, Video, find_videos, plan_jobs
from factorsfm.batch.worker import find_shots_of, reconstruct_shot
from factorsfm.camera.files import open_camera
from factorsfm.cli.command import Command, add_align, add_footage, add_method, add_objects, add_output, count_of
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.priors.depth import open_depth
from factorsfm.priors.masks import open_masks
from factorsfm.priors.object_masks import FROM_MOTION, open_objects
from factorsfm.report.result_folder import check_directory, is_earlier_result, remove_result, write_failure
from factorsfm.support.errors import FactorsfmError, InputError, ReconstructionError
from factorsfm.support.json_text import json_text
from factorsfm.support.options import Options
from factorsfm.support.threads import available_cores

Show = Callable[[str], None]

logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("source", metavar="SOURCE", help="a video file, or a folder of video files")
    add_output(parser, "folder of the results: new, empty, or that of an earlier run, which goes on")
    add_method(parser)
    add_footage(parser)
    add_objects(parser)
    add_align(parser)
    parser.add_argument(
        "--workers",
        type=count_of("processes"),
        metavar="N",
        help="processes, each with a shot and its share of the cores (default: one for every core)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster whose workers see the same files, as HOST:PORT"
    )


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Reconstruct every shot that an earlier run has not done; see `Command.run`."""
    show = progress.show
    if arguments.workers and arguments.scheduler:
        raise InputError("--workers and --scheduler cannot be combined: a cluster has its own workers")
    source, output = Path(arguments.source), arguments.output
    videos = find_videos(source, arguments.fields)
    known = shots_known(output, source)
    method = _method(arguments, several=source.is_dir())
    most, scheduler = arguments.workers or len(available_cores()), arguments.scheduler
    workers = min(most, len(videos))
    with open_crew(workers, scheduler) as crew:
        shots, unread = _find_shots(crew, videos, known, one_thread=_one_thread(workers, scheduler), show=show)
    jobs = plan_jobs(shots, method, output, several=source.is_dir())
    for job in jobs:
        check_directory(job.folder, job.video.path)
    _remove_others(output, jobs, unread)
    index = Index(source, output, shots, unread, jobs)
    waiting = [job for job in jobs if not job.is_done()]
    for job in jobs:
        if job not in waiting:
            index.add(job)
    index.write()
    workers = max(1, min(most, len(waiting)))
    with open_crew(workers, scheduler) as crew:
        told = progress if workers == 1 and scheduler is None else None
        work = partial(reconstruct_shot, one_thread=_one_thread(workers, scheduler), progress=told)
        _reconstruct(crew, work, waiting, index, show)
    return _conclusion(index.entries, unread, output)


def _one_thread(workers: int, scheduler: str | None) -> bool:
    """Whether each worker uses one thread, because it has only one core.

    On a cluster the number of cores per worker is unknown, so each uses one.
    """
    return scheduler is not None or len(available_cores()) < 2 * workers


def _method(arguments: argparse.Namespace, *, several: bool) -> Method:
    """The arguments for all shots; opens camera, prior and masks once, to find errors before the work."""
    depth, masks = map(_absolute, (arguments.depth, arguments.masks))
    objects = FROM_MOTION if arguments.objects == FROM_MOTION else _absolute(arguments.objects)
    if Options.preset_named(arguments.preset).uses_depth and not (several and depth and Path(depth).is_dir()):
        open_depth(depth, arguments.depth_kind)
    if not (several and masks and Path(masks).is_dir()):
        open_masks(masks)
    if not several and objects != FROM_MOTION:
        open_objects(objects)
    camera = open_camera(arguments.camera)
    return Method(
        camera, depth, arguments.depth_kind, masks, objects, arguments.preset, arguments.lens, arguments.shutter,
        arguments.pixel_aspect, arguments.align,
    )  # fmt: skip


def _absolute(text: str | None) -> str | None:
    """An absolute path, since workers may have another working directory; None for "none"."""
    if text is None or text == "none":
        return None
    return str(Path(text).resolve()) if Path(text).exists() else text


def _find_shots(
    crew: Crew, videos: Sequence[Video], known: dict[str, list[range]], *, one_thread: bool, show: Show
) -> tuple[dict[Video, list[range]], dict[Video, str]]:
    """The shots of the videos that can be read, and the reasons of the others.

    Raises:
        InputError: no video can be read.
    """
    found = {video: known[key] for video in videos if (key := json_text(video.to_dict())) in known}
    unread: dict[Video, str] = {}
    show(f"looking for cuts in {len(videos)} videos")
    new = [video for video in videos if video not in found]
    for done, (video, outcome) in enumerate(crew.run(partial(find_shots_of, one_thread=one_thread), new), 1):
        show(f"looking for cuts: {done} of {len(new)} videos")
        if isinstance(outcome, BaseException):
            unread[video] = str(outcome)
        else:
            found[video] = outcome
    if not found:
        raise InputError(next(iter(unread.values())))
    return {video: found[video] for video in videos if video in found}, unread


def _reconstruct(crew: Crew, work: Callable[[Job], None], jobs: Sequence[Job], index: Index, show: Show) -> None:
    """Do the jobs, longest first, so that all workers end at about the same time."""
    line = _Line(show, len(index.entries), jobs)
    for job, outcome in crew.run(work, sorted(jobs, key=lambda job: -len(job.frames))):
        if isinstance(outcome, BaseException):
            logger.info("%s failed", job.folder, exc_info=outcome)
            said = str(outcome) if isinstance(outcome, FactorsfmError) else f"{type(outcome).__name__}: {outcome}"
            # The summary does not name the job, so the next run tries again.
            write_failure(job.folder, said, options={"source": str(job.video.path)})
        index.add(job)
        index.write()
        line.tell(job)


def _remove_others(output: Path, jobs: Sequence[Job], unread: Collection[Video]) -> None:
    """Remove results of an earlier run that belong to no job, from videos that had more shots.

    Results of videos that cannot be read now stay.
    """
    kept = {job.folder for job in jobs}
    unreadable = {video.name for video in unread}
    for folder in output.absolute().glob("*/shot_*"):
        if folder not in kept and folder.parent.name not in unreadable and is_earlier_result(folder):
            logger.info("%s is removed: the video has no such shot any more", folder)
            remove_result(folder)


class _Line:
    """The line of progress: shots done, and time left."""

    def __init__(self, show: Show, done: int, waiting: Sequence[Job]) -> None:
        self._show, self._shots, self._done = show, done + len(waiting), done
        self._frames, self._frames_done = sum(len(job.frames) for job in waiting), 0
        self._begin = time.monotonic()
        show(f"shot {self._done} of {self._shots}")

    def tell(self, job: Job) -> None:
        self._done += 1
        self._frames_done += len(job.frames)
        left = (time.monotonic() - self._begin) * (self._frames / self._frames_done - 1.0)
        self._show(f"{self._done} of {self._shots} shots done, {_remaining(left)} left")


def _remaining(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def _conclusion(entries: Sequence[Entry], unread: dict[Video, str], output: Path) -> str:
    lines = [
        f"{entry.folder}, frames {entry.frames[0]} to {entry.frames[1] - 1}: "
        f"{'' if entry.reconstructed else 'not reconstructed: '}{entry.verdict}."
        for entry in entries
    ]
    lines += [f"{video.path.name}: {reason}." for video, reason in unread.items()]
    if not any(entry.reconstructed for entry in entries):
        raise ReconstructionError(f"none of {len(entries)} shots could be reconstructed; {lines[0]}")
    return "\n".join([*lines, f"Results in {output}; open {output / 'index.html'}"])


COMMAND = Command(
    "batch",
    help="reconstruct every shot of a film, or of a folder of films",
    description="Find the shots of a film, or of all films in a folder, and reconstruct each; goes on where it was "
    "interrupted.",
    add_arguments=add_arguments,
    run=run,
    followed=True,
)
