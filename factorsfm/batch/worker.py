"""What a worker does with a job: the same as ``factorsfm reconstruct``, and the result or the failure on disk."""

from __future__ import annotations

import time
from contextlib import nullcontext

from factorsfm import api
from factorsfm.batch.plan import Job, Video, shots_of
from factorsfm.report.result_folder import write_failure, write_folder
from factorsfm.support.errors import FactorsfmError, ReconstructionError
from factorsfm.support.progress import Progress
from factorsfm.support.threads import OneThreadEach


def find_shots_of(video: Video, *, one_thread: bool) -> list[range]:
    """Shots of a video; errors as in `plan.shots_of`."""
    with OneThreadEach() if one_thread else nullcontext():
        return shots_of(video)


def reconstruct_shot(job: Job, *, one_thread: bool, progress: Progress | None = None) -> None:
    """Write the result of a shot, or why there is none.

    Args:
        one_thread: keep to one thread, where there is no more than a core for each worker.

    Raises:
        InputError: the folder cannot be written.
    """
    begin = time.perf_counter()
    method = job.method
    try:
        # A network opened inside keeps to one thread, too, see `priors.networks`.
        with OneThreadEach() if one_thread else nullcontext():
            reconstruction = api.reconstruct(
                job.video.path,
                camera=method.camera,
                depth=method.depth,
                depth_kind=method.depth_kind,
                masks=method.masks,
                frames=slice(job.frames.start, job.frames.stop),
                preset=method.preset,
                lens=method.lens,
                shutter=method.shutter,
                progress=progress,
            )
    except FactorsfmError as error:
        frames = error.frames if isinstance(error, ReconstructionError) else ()
        options = {"source": str(job.video.path), "job": job.to_dict()}
        write_failure(job.folder, str(error), frames, options, {"total": time.perf_counter() - begin})
        return
    reconstruction.options["job"] = job.to_dict()
    write_folder(reconstruction, job.folder)
